from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from client import export
from exchange.errors import ExchangeError
from exchange.native import read_native
from tests.client.scripted_node import SPEC, synthetic_grid

GRID = synthetic_grid()


def test_npz_holds_the_very_same_grid(tmp_path: Path) -> None:
    export.write_grid(GRID, tmp_path / "model.npz")
    with open(tmp_path / "model.npz", "rb") as file:
        _, back, _ = read_native(file)
    assert back.spec == SPEC and np.array_equal(back.range_steps, GRID.range_steps)
    assert np.array_equal(back.texture, GRID.texture)


def test_glb_is_a_mesh_in_metres(tmp_path: Path) -> None:
    export.write_grid(GRID, tmp_path / "MODEL.GLB")
    low, high = trimesh.load_scene(tmp_path / "MODEL.GLB").bounds
    assert high[1] - low[1] == pytest.approx((SPEC.height - 1) * SPEC.pitch_mm / 1000)


@pytest.mark.parametrize("name", ["model.xyz", "model"])
def test_a_format_we_do_not_write_is_named_with_those_we_do(name: str, tmp_path: Path) -> None:
    with pytest.raises(ExchangeError, match=r"\.glb, .*\.npz"):
        export.write_grid(GRID, tmp_path / name)
    assert not list(tmp_path.iterdir())
