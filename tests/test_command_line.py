import argparse
import errno
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

import foveascan
from client.errors import NodeLost
from foveascan import PROGRAM
from protocol.errors import ConfigError, FoveascanError, LibraryError

HEAVY = {"numpy", "cv2", "imagecodecs", "msgspec", "aiohttp", "asyncio", "zeroconf", "serial", "usb", "trimesh", "tqdm"}


def offer(monkeypatch: pytest.MonkeyPatch, run: Callable[..., int]) -> None:
    """Let `foveascan try` do `run`."""

    def add_subcommands(subparsers: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
        subparsers.add_parser("try").set_defaults(run=run)

    monkeypatch.setattr(foveascan, "add_own_subcommands", add_subcommands)


def raising(problem: BaseException) -> Callable[..., int]:
    def run(_: object) -> int:
        raise problem

    return run


def foveascan_process(*arguments: str, **options: object) -> "subprocess.CompletedProcess[str]":
    return subprocess.run([*PROGRAM, *arguments], capture_output=True, text=True, timeout=60, **options)  # type: ignore[call-overload, no-any-return]


def test_help_names_every_subcommand_and_imports_nothing_heavy() -> None:
    code = "import sys, foveascan; print(foveascan.build_parser().format_help()); print(*sys.modules, file=sys.stderr)"
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert "demo" in told.stdout
    assert HEAVY.isdisjoint(told.stderr.split())


def test_version_is_the_one_of_the_distribution() -> None:
    from importlib.metadata import version

    assert foveascan_process("--version").stdout == f"foveascan {version('foveascan')}\n"


@pytest.mark.parametrize(
    "arguments",
    [
        (), ("no-such-command",), ("demo", "--size", "XL"), ("demo", "--siz", "S"), ("demo", "--link-rate", "0"),
        ("serve", "--baud", "5"), ("access", "audit", "--since", "yesterday"),
    ],
)  # fmt: skip
def test_wrong_usage_is_status_2_and_a_hint(arguments: tuple[str, ...]) -> None:
    done = foveascan_process(*arguments)
    assert (done.returncode, done.stdout) == (2, "")
    assert "usage: foveascan" in done.stderr


@pytest.mark.parametrize(
    ("arguments", "hint"),
    [
        (("library", "prune", "--max-age-days", "0"), "retention.max_age_days: expected float >= 1.0"),
        (("serve", "--check", "--scanner", "tcp:foo"), "capture.scanner: 'tcp:foo' is not tcp:HOST:PORT or"),
        (("serve", "--check", "--scanner", "usb:12"), "capture.scanner: 'usb:12' is not usb:VENDOR:PRODUCT or"),
        (("serve", "--check", "--listen", "7345"), "server.listen: expected HOST:PORT or [IPv6]:PORT"),
        (("simulate", "--path", "p", "--faults", "nope=1"), "faults: 'nope' is none of loss,"),
        (("simulate", "--path", "p", "--faults", "dead=1.5"), "faults: dead=1.5 is not a whole number between 0 and"),
        (("simulate", "--path", "99999", "--link", "tcp"), "path: expected PORT or HOST:PORT"),
        (("simulate", "--path", "p", "--specimen", "nothing"), "specimen: nothing is none of"),
        (("demo", "--specimen", "nothing"), "specimen: nothing is none of"),
    ],
)
def test_a_value_that_makes_no_sense_is_status_2_and_one_line(arguments: tuple[str, ...], hint: str) -> None:
    done = foveascan_process(*arguments)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith(f"foveascan: {hint}") and done.stderr.count("\n") == 1


def test_a_damaged_image_is_an_error_and_no_noise() -> None:
    code = """
import sys, foveascan, numpy
from protocol.codec_htj2k import CodecError, decode, encode
foveascan._hush_codecs()
coded = bytearray(encode(numpy.random.default_rng(1).integers(0, 255, (64, 64, 3), numpy.uint8), 255))
for at in range(10, 300, 10):
    coded[at] ^= 0xFF
    try:
        decode(bytes(coded), (64, 64, 3), 255)
    except CodecError:
        print("found")
"""
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert (told.returncode, told.stderr) == (0, "") and "found" in told.stdout


def test_the_status_of_a_subcommand_is_the_status_of_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    offer(monkeypatch, lambda args: 7)
    assert foveascan.main(["try"]) == 7


def caused(problem: Exception, number: int) -> Exception:
    problem.__cause__ = OSError(number, os.strerror(number))
    return problem


@pytest.mark.parametrize(
    ("problem", "line"),
    [
        (ConfigError("capture.baud: expected int"), "capture.baud: expected int"),
        (FoveascanError("two\nlines\tof it"), "two lines of it"),
        (FoveascanError(), "FoveascanError"),
        (FoveascanError("said by a node: \x1b[31m"), r"said by a node: \x1b[31m"),
        (FileNotFoundError(errno.ENOENT, "No such file or directory", "a.toml"),
         "a.toml: No such file or directory; check the path"),
        (OSError(errno.EADDRINUSE, "Address already in use"),
         "Address already in use; another program listens there: stop it or choose another --listen"),
        (OSError("a message without a number"), "a message without a number"),
        (caused(LibraryError("the library a cannot be used: Read-only file system"), errno.EROFS),
         "the library a cannot be used: Read-only file system; choose a folder that can be written"),
        (caused(NodeLost("connection refused; start a node"), errno.ECONNREFUSED), "connection refused; start a node"),
    ],
)  # fmt: skip
def test_failure_is_one_line_on_stderr(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], problem: Exception, line: str
) -> None:
    offer(monkeypatch, raising(problem))
    assert foveascan.main(["try"]) == 1
    assert capsys.readouterr() == ("", f"foveascan: {line}\n")


def test_an_interrupt_is_status_130_and_quiet(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    offer(monkeypatch, raising(KeyboardInterrupt()))
    assert foveascan.main(["try"]) == 130
    assert capsys.readouterr() == ("", "")


def test_a_bug_shows_its_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    offer(monkeypatch, raising(ZeroDivisionError()))
    with pytest.raises(ZeroDivisionError):
        foveascan.main(["try"])


def test_a_reader_that_went_away_is_status_141_and_quiet() -> None:
    code = """
import sys, foveascan
foveascan.add_own_subcommands = lambda subparsers: subparsers.add_parser("try").set_defaults(run=print)
sys.exit(foveascan.main(["try"]))
"""
    read_end, write_end = os.pipe()
    os.close(read_end)
    done = subprocess.run([sys.executable, "-c", code], stdout=write_end, stderr=subprocess.PIPE, timeout=60)
    os.close(write_end)
    assert (done.returncode, done.stderr) == (141, b"")


def test_a_program_is_started_elsewhere_than_its_folder(tmp_path: Path) -> None:
    (tmp_path / "protocol.py").write_text("raise SystemExit('the wrong protocol')")
    assert foveascan_process("--version", cwd=tmp_path).returncode == 0


def program(monkeypatch: pytest.MonkeyPatch, code: str) -> None:
    """Let `started` start this Python code instead of foveascan."""
    monkeypatch.setattr(foveascan, "PROGRAM", (sys.executable, "-c", code))


def test_a_started_program_tells_when_it_is_ready_and_ends_with_the_block(monkeypatch: pytest.MonkeyPatch) -> None:
    program(monkeypatch, "import json, sys, signal; print(json.dumps({'a': sys.argv[1:]}), flush=True); signal.pause()")
    with foveascan.started("simulate", "--json") as (process, ready):
        assert ready == {"a": ["simulate", "--json"]}
        assert process.poll() is None
    assert process.returncode == -15


def test_a_program_deaf_to_sigterm_is_killed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(foveascan, "END_S", 0.1)
    program(monkeypatch, "import signal; signal.signal(15, signal.SIG_IGN); print('{}', flush=True); signal.pause()")
    with foveascan.started("serve") as (process, _):
        pass
    assert process.returncode == -9


@pytest.mark.parametrize(
    ("code", "message"),
    [
        ("raise SystemExit(3)", "^serve ended with status 3 before it was ready"),
        ("print('hello')", "^serve began with b'hello.n' instead of a line of JSON"),
    ],
)
def test_a_program_that_is_never_ready_is_an_error(monkeypatch: pytest.MonkeyPatch, code: str, message: str) -> None:
    program(monkeypatch, code)
    with pytest.raises(FoveascanError, match=message), foveascan.started("serve"):
        pytest.fail("never ready")


DEMO = """
import sys
import foveascan
foveascan.PROGRAM = (sys.executable, sys.argv[1])
sys.exit(foveascan.main(["demo", "--size", "S"]))
"""
PROGRAM_OF_DEMO = """
import json, pathlib, signal, sys
verb = sys.argv[1]
def log(*words):
    with open(pathlib.Path(__file__).with_name("log"), "a") as file:
        print(*words, file=file)
def end(*_):
    log(verb, "ended")
    sys.exit(0)
signal.signal(signal.SIGTERM, end)
log(*sys.argv[1:4])
if verb != "scan":
    print(json.dumps({"ready": True, "path": "/the/link", "url": "http://127.0.0.1:1"}), flush=True)
    signal.pause()
"""


def test_demo_sweeps_the_simulated_scanner_and_ends_both_programs_on_sigterm(tmp_path: Path) -> None:
    stand_in = tmp_path / "program.py"
    stand_in.write_text(PROGRAM_OF_DEMO)
    with subprocess.Popen([sys.executable, "-c", DEMO, str(stand_in)], stdout=subprocess.PIPE, text=True) as demo:
        assert demo.stdout is not None
        assert demo.stdout.readline() == "The scan is at http://127.0.0.1:1\n"
        demo.terminate()
    assert demo.returncode == 0
    assert (tmp_path / "log").read_text().splitlines() == [
        "simulate --link pty",
        "serve --scanner /the/link",
        "scan --node http://127.0.0.1:1",
        "serve ended",
        "simulate ended",
    ]
