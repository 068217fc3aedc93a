"""The page's own unit tests, in TypeScript, and its size: the build that pytest can see."""

from __future__ import annotations

import subprocess
from pathlib import Path

import hatch_build

SIZE_MAX_BYTES = 400 * 1000


def test_typescript_units(tmp_path: Path) -> None:
    hatch_build.install_packages(hatch_build.VIEWER)
    node = hatch_build.node_commands()[0]
    subprocess.run([*node, "build.mjs", "--tests", str(tmp_path)], cwd=hatch_build.VIEWER, check=True)
    files = sorted(str(path) for path in tmp_path.glob("*.test.mjs"))
    assert files
    done = subprocess.run([*node, "--test", *files], cwd=hatch_build.VIEWER, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout


def test_the_page_and_its_code_are_small() -> None:
    assert hatch_build.is_fresh(hatch_build.VIEWER), "run `make`"
    packed = [path.stat().st_size for path in (hatch_build.VIEWER / "dist").glob("*.gz")]
    assert 0 < sum(packed) <= SIZE_MAX_BYTES
