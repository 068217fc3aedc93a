from __future__ import annotations

from pathlib import Path
from typing import BinaryIO

import numpy as np
import pytest

from client import export
from client.errors import ExportError
from protocol.grid import Grid
from tests.client.scripted_node import SPEC, synthetic_grid

GRID = synthetic_grid()


def test_npz_holds_the_native_grid(tmp_path: Path) -> None:
    export.write_grid(GRID, tmp_path / "model.npz")
    with np.load(tmp_path / "model.npz", allow_pickle=False) as file:
        assert np.array_equal(file["range_steps"], GRID.range_steps) and file["range_steps"].dtype == np.uint16
        assert np.array_equal(file["texture"], GRID.texture)
        geometry = {name: float(file[name]) for name in ("step_mm", "pitch_mm", "z_max_mm", "theta0_rad")}
    assert geometry == {name: getattr(SPEC, name) for name in geometry}


def test_a_written_file_replaces_an_older_one_and_leaves_nothing_beside_it(tmp_path: Path) -> None:
    target = tmp_path / "model.NPZ"
    target.write_bytes(b"old")
    export.write_grid(GRID, target)
    assert target.read_bytes() != b"old" and list(tmp_path.iterdir()) == [target]


def test_a_failed_write_leaves_the_older_file_and_nothing_beside_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(grid: Grid, file: BinaryIO) -> None:
        file.write(b"half")
        raise OSError("disk full")

    monkeypatch.setitem(export.WRITERS, ".npz", fail)
    target = tmp_path / "model.npz"
    target.write_bytes(b"old")
    with pytest.raises(OSError, match="disk full"):
        export.write_grid(GRID, target)
    assert target.read_bytes() == b"old" and list(tmp_path.iterdir()) == [target]


@pytest.mark.parametrize("name", ["model.xyz", "model"])
def test_a_format_we_do_not_write_is_named_with_those_we_do(name: str, tmp_path: Path) -> None:
    with pytest.raises(ExportError, match=r"\.npz"):
        export.write_grid(GRID, tmp_path / name)
    assert not list(tmp_path.iterdir())
