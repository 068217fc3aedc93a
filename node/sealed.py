"""A sealed library: encrypted on the disk by gocryptfs, and to be read only while that is mounted.

    <folder>            the library, while it is open; an empty folder else
    <folder>.sealed     what lies on the disk: encrypted files under encrypted names, and gocryptfs.conf, which holds
                        the data key, encrypted with the operator's

    .<folder>.sealing, .away, .coming, .gone        while it is being sealed or unsealed (node.sealing)

The key is one line of text; nothing of it is kept here.
"""

from __future__ import annotations

import errno
import os
import shlex
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from node.durable import read_bounded, sync_folder
from protocol.errors import LibraryError

SUFFIX = ".sealed"
CONF = "gocryptfs.conf"
KIND = "fuse.gocryptfs"
MOUNTS = Path("/proc/self/mountinfo")
KEY_CHARACTERS = 22, 500  # 128 bits in base64; what gocryptfs takes
NEW_KEY = "head -c 32 /dev/urandom | base64 -w0"
STRETCH = "10"  # the least: a key is random, and nothing is won by making its trial slow
MOUNT_S = 30.0
OPEN_IT = "systemctl start foveascan-vault, or mount it (README, \"A sealed library\")"
OPEN_AGAIN = "systemctl restart foveascan-vault, or umount it and mount it again (README, \"A sealed library\")"
HAS_DIED = "what had opened the library, which is sealed, has died: restart foveascan-vault on the node"
LEFT = "away", "gone", "sealing", "coming"
WRONG_KEY = 12  # gocryptfs's status
_ESCAPED = {"\\040": " ", "\\011": "\t", "\\012": "\n", "\\134": "\\"}


def sealed_folder(folder: Path) -> Path:
    """Where a sealed library lies on the disk."""
    return folder.with_name(folder.name + SUFFIX)


def beside(folder: Path, word: str) -> Path:
    """Where something lies while a library is being sealed or unsealed."""
    return folder.with_name(f".{folder.name}.{word}")


def is_sealed(folder: Path) -> bool:
    """Whether a library lies sealed on the disk."""
    return is_kept(sealed_folder(folder))


def is_kept(sealed: Path) -> bool:
    """Whether a folder is one that a key may open, or may be for all that we may look into it. Raises OSError."""
    try:
        return (sealed / CONF).exists()
    except PermissionError:
        return sealed.is_dir()


def is_open(folder: Path) -> bool:
    """Whether a folder lies in what gocryptfs has mounted now, dead or alive. Raises OSError."""
    place, best, kind = os.path.realpath(folder), "", ""
    for line in MOUNTS.read_text().splitlines():
        words = line.split()
        point = words[4]
        for code, char in _ESCAPED.items():
            point = point.replace(code, char)
        if len(point) >= len(best) and (place + "/").startswith(point.rstrip("/") + "/"):
            best, kind = point, words[words.index("-") + 1]
    return kind == KIND


def is_shut(folder: Path) -> bool:
    """Whether a library is sealed and not open, so that whatever is written here would lie in the clear beside it."""
    return (_is_cut(folder) or is_sealed(folder)) and not is_open(folder)


def why_shut(folder: Path) -> tuple[str, str] | None:
    """What keeps a sealed library from being read, and the cure; None where it is open, or not sealed.

    Raises OSError.
    """
    if is_shut(folder):
        if _is_cut(folder):
            return f"{folder} was being sealed or unsealed when that was cut", f"stop the node, and {finish(folder)}"
        return f"{folder} is sealed and not open", OPEN_IT
    if is_open(folder):
        try:
            os.statvfs(folder)  # asks it, where attributes may be remembered
        except OSError as error:
            if error.errno == errno.ENOTCONN:
                return f"what had opened {folder}, which is sealed, has died", OPEN_AGAIN
    return None


def has_died(error: BaseException) -> bool:
    """Whether it came of this: what had opened a sealed library has died."""
    cause: BaseException | None = error
    while cause is not None and not (isinstance(cause, OSError) and cause.errno == errno.ENOTCONN):
        cause = cause.__cause__
    return cause is not None


def _is_cut(folder: Path) -> bool:
    return any(beside(folder, word).exists() for word in ("away", "gone"))


def leftovers(folder: Path) -> list[Path]:
    """What a seal or an unseal that was cut has left beside a library; also what one has that runs."""
    return [place for word in LEFT if (place := beside(folder, word)).exists()]


def standing(folder: Path) -> str:
    """Where a seal or an unseal stands that was cut, and how to go on, in a line."""
    left = {word: place for word in LEFT if (place := beside(folder, word)).exists()}
    if "away" in left:
        return f"all of {folder} is encrypted, and {left['away']} is still to be deleted; to end that: {finish(folder)}"
    if "gone" in left:
        return f"all of {folder} is in the clear, {left['gone']} is still to be deleted; to end that: {finish(folder)}"
    was = f"{folder} is {'sealed' if is_sealed(folder) else 'in the clear'}, as it was"
    if left:
        part = next(iter(left.values()))
        return f"{was}, and {part} is the part that was copied; to go on: {finish(folder)}; to let it be: rm -r {part}"
    return was


def finish(folder: Path) -> str:
    """The command that ends what was cut."""
    verb = "unseal" if any(beside(folder, word).exists() for word in ("gone", "coming")) else "seal"
    return shlex.join(["foveascan", "library", verb, "--library", str(folder), "--key", "FILE"])


def holds_something(folder: Path) -> bool:
    """Whether there is a folder that is not empty."""
    try:
        with os.scandir(folder) as entries:
            return next(entries, None) is not None
    except FileNotFoundError:
        return False


def read_key(path: Path) -> bytes:
    """The key in a file. Raises LibraryError where that is no line of text, or one to be guessed; OSError."""
    data = read_bounded(path, 4096).strip(b"\r\n")
    least, most = KEY_CHARACTERS
    if not least <= len(data) <= most or not all(0x20 <= byte < 0x7F for byte in data):
        raise LibraryError(f"{path} holds no key, which is a line of {least} to {most} characters: {NEW_KEY} > {path}")
    return data


def make_sealed(sealed: Path, key: bytes) -> None:
    """Make an empty sealed folder, unless it is there. Raises LibraryError, OSError."""
    if (sealed / CONF).exists():
        return
    if sealed.exists():
        shutil.rmtree(sealed)
    sealed.mkdir(mode=0o700)
    _run("-init", "-scryptn", STRETCH, str(sealed), said=key)
    sync_folder(sealed)


def change_key(sealed: Path, old: bytes, new: bytes) -> None:
    """Encrypt the data key with another one, at once; no scan is written. Raises LibraryError.

    It is one step, so who interrupts it comes too late.
    """
    with suppress(KeyboardInterrupt):
        _run("-passwd", "-scryptn", STRETCH, str(sealed), said=old + b"\n" + new)


@contextmanager
def opened(sealed: Path, place: Path, key: bytes) -> Iterator[Path]:
    """A sealed folder's content, in a folder that nobody else may look into. Raises LibraryError, OSError."""
    shut(place)  # whoever had it open was killed
    place.mkdir(mode=0o700, exist_ok=True)
    with tempfile.TemporaryFile() as said:
        command = ["gocryptfs", "-fg", "-q", "-nosyslog", str(sealed), str(place)]
        process = _started(command, said.fileno())
        try:
            assert process.stdin is not None
            with process.stdin:
                process.stdin.write(key + b"\n")
            _await_mount(process, place, said.fileno())
            yield place
        finally:
            shut(place)
            if process.poll() is None:
                process.terminate()
            process.wait()
            place.rmdir()


def shut(place: Path) -> None:
    """Unmount a folder, if something of gocryptfs's is mounted there. Raises LibraryError."""
    if not os.path.ismount(place):
        return
    command = ["umount"] if os.geteuid() == 0 else ["fusermount3", "-u"]
    done = subprocess.run([*command, str(place)], capture_output=True, text=True, check=False)
    if done.returncode:
        raise LibraryError(f"cannot shut {place}: {' '.join(done.stderr.split())}; end whoever uses it")


def _started(command: list[str], errors: int) -> subprocess.Popen[bytes]:
    """gocryptfs, which Ctrl-C does not reach: we end it in our order. Raises LibraryError."""
    try:
        return subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=errors, process_group=0
        )
    except FileNotFoundError:
        raise LibraryError("a sealed library needs gocryptfs; as root: apt-get install gocryptfs fuse3") from None


def _await_mount(process: subprocess.Popen[bytes], place: Path, errors: int) -> None:
    deadline_s = time.monotonic() + MOUNT_S
    while not os.path.ismount(place):
        if process.poll() is not None:
            raise _refusal(process.returncode, os.pread(errors, 4096, 0))
        if time.monotonic() > deadline_s:
            raise LibraryError(f"gocryptfs has not mounted {place} within {MOUNT_S:.0f} s")
        time.sleep(0.01)


def _run(*arguments: str, said: bytes) -> None:
    """Have gocryptfs do something. said : lines for its standard input, so that no list of processes shows a key."""
    with tempfile.TemporaryFile() as errors:
        process = _started(["gocryptfs", "-q", "-nosyslog", *arguments], errors.fileno())
        interrupt: KeyboardInterrupt | None = None
        try:
            process.communicate(said + b"\n")
        except KeyboardInterrupt as pressed:
            interrupt = pressed
            process.wait()
        if process.returncode:
            raise _refusal(process.returncode, os.pread(errors.fileno(), 4096, 0))
        if interrupt is not None:
            raise interrupt


def _refusal(status: int, said: bytes) -> LibraryError:
    if status == WRONG_KEY:
        return LibraryError("this key does not open the library: give the one that it was sealed with; nothing changed")
    lines = said.decode(errors="replace").split("\n")
    why = next((line.strip() for line in reversed(lines) if line.strip()), f"status {status}")
    return LibraryError(f"gocryptfs: {why}")
