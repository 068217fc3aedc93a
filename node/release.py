"""The program as a service runs it: a copy of what runs here, in a Python environment of its own.

    /opt/foveascan/releases/0.1.0-1f3a90c2/bin/foveascan     one folder for each version, never changed
    /opt/foveascan/bin -> releases/0.1.0-1f3a90c2/bin        the one that runs; exchanged in one step

Copying what was installed here needs no network, and what runs there is what was tried here, to the byte.
"""

from __future__ import annotations

import compileall
import hashlib
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterable, Sequence
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path

from protocol.errors import InstallError

OURS = "foveascan"
PACKAGES = ("protocol", "drivers", "exchange", "node", "client", "simulators")
HERE = Path(__file__).resolve().parent.parent
PAGE = Path("client") / "viewer"
UNIT_FILES = "systemd"
CACHES = "__pycache__"
OF_PIP = frozenset({"RECORD", "INSTALLER", "REQUESTED", "direct_url.json"})
COMMAND = "import sys\n\nfrom foveascan import main\n\nsys.exit(main())\n"
RUN_S = 180


def unit_files() -> Path:
    """The folder of unit, rule and settings: in a checkout beside the packages, else in this one."""
    inside = HERE / "node" / UNIT_FILES
    return inside if inside.is_dir() else HERE / UNIT_FILES


def identity() -> str:
    """What tells this version from others: the version's name, and a hash of all that a release holds."""
    total = hashlib.sha256()
    for found in distributions():
        total.update(f"{found.name} {found.version}\n".encode())
    for name, path in _own_files():
        total.update(f"{name} {path.stat().st_size}\n".encode())
        total.update(path.read_bytes())
    total.update(os.path.realpath(sys.executable).encode())
    return f"{distribution(OURS).version}-{total.hexdigest()[:8]}"


def distributions() -> list[Distribution]:
    """This program's distribution and those it needs, and those need. Raises InstallError."""
    found: dict[str, Distribution] = {}
    wanted = [OURS]
    while wanted:
        name = _normal(wanted.pop())
        if name in found:
            continue
        try:
            found[name] = distribution(name)
        except PackageNotFoundError:
            if name == OURS:
                raise InstallError("foveascan is not installed here: pip install it, then try again") from None
            continue  # for another platform
        needed = (text for text in found[name].requires or () if "extra ==" not in text)
        wanted += [re.split(r"[^A-Za-z0-9._-]", text, maxsplit=1)[0] for text in needed]
    return [found[name] for name in sorted(found)]


def build(place: Path) -> None:
    """Make a release in a folder that is not there yet, whole or not at all. Raises InstallError, OSError."""
    new = place.with_name(f".{place.name}.new")
    shutil.rmtree(new, ignore_errors=True)
    try:
        site = new / "lib" / f"python{sys.version_info.major}.{sys.version_info.minor}" / "site-packages"
        site.mkdir(parents=True)
        for found in distributions():
            _copy_distribution(found, site)
        for name, path in _own_files():
            (site / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, site / name)
        _make_environment(new, place)
        compileall.compile_dir(site, quiet=2)
        _open_to_all(new)
        _try(new)
        new.rename(place)
    except BaseException:
        shutil.rmtree(new, ignore_errors=True)
        raise


def run(command: Sequence[str]) -> subprocess.CompletedProcess[str]:
    """Run a command to its end, whatever its status. Raises InstallError when it takes too long, OSError."""
    try:
        return subprocess.run(command, capture_output=True, text=True, timeout=RUN_S)
    except subprocess.TimeoutExpired:
        raise InstallError(f"{' '.join(command)} did not end within {RUN_S} s") from None


def require_python() -> None:
    """Raises InstallError where a service could not run the Python that runs this: its unit sees no homes."""
    home = os.path.realpath(sys.base_prefix)
    if home.startswith(("/root/", "/home/", "/run/user/")):
        cure = "make the environment with the system's Python: /usr/bin/python3 -m venv"
        raise InstallError(f"this Python lies in {home}, which no service sees; {cure}")


def _copy_distribution(found: Distribution, site: Path) -> None:
    if found.files is None:
        raise InstallError(f"{found.name} was not installed by pip: make an environment of its own for foveascan")
    for file in found.files:
        is_ours = _normal(found.name) == OURS
        if ".." in file.parts or CACHES in file.parts or file.name in OF_PIP:
            continue
        if is_ours and not file.parts[0].endswith(".dist-info"):
            continue  # `_own_files` knows them, also where they are not copied but linked to
        source = Path(str(file.locate()))
        if not source.is_file():
            raise InstallError(f"{found.name} is damaged here, {source} is missing: install it anew")
        (site / file).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(source, site / file)


def _own_files() -> Iterable[tuple[str, Path]]:
    """The files of our own packages, by the names that they have in a release."""
    if not (HERE / PAGE / "dist" / "index.html").is_file():
        raise InstallError("the page is not built: run make first")
    yield f"{OURS}.py", HERE / f"{OURS}.py"
    for package in PACKAGES:
        for path in sorted((HERE / package).rglob("*")):
            name = path.relative_to(HERE)
            if CACHES in name.parts or not path.is_file():
                continue
            if name.is_relative_to(PAGE) and not name.is_relative_to(PAGE / "dist"):
                continue
            yield str(name), path
    if unit_files().parent == HERE:
        for path in sorted(unit_files().iterdir()):
            yield str(Path("node") / UNIT_FILES / path.name), path


def _make_environment(new: Path, place: Path) -> None:
    """What makes a folder a Python environment (PEP 405), and the command in it."""
    base = os.path.realpath(sys.executable)
    (new / "pyvenv.cfg").write_text(f"home = {Path(base).parent}\ninclude-system-site-packages = false\n")
    (new / "bin").mkdir()
    (new / "bin" / "python").symlink_to(base)
    command = new / "bin" / OURS
    command.write_text(f"#!{logical(place)}/bin/python -I\n{COMMAND}")
    command.chmod(0o755)


def logical(place: Path) -> str:
    """A place as it will be called once its root is /: what stands from /opt on."""
    text = str(place)
    return text[text.rindex("/opt/foveascan") :]


def _open_to_all(folder: Path) -> None:
    """Others run this, whatever the umask of who installs it."""
    for path in (folder, *folder.rglob("*")):
        if not path.is_symlink():
            path.chmod(0o755 if path.is_dir() or os.access(path, os.X_OK) and path.stat().st_mode & 0o100 else 0o644)


def _try(new: Path) -> None:
    """Raises InstallError unless the copy runs."""
    command = [str(new / "bin" / "python"), "-I", "-m", OURS, "serve", "--check"]
    tried = run(command)
    if tried.returncode:
        said = "".join(tried.stderr.strip().splitlines()[-1:])
        raise InstallError(f"the copy does not run: {said}")


def _normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()
