"""Grids on disk: round trip, and a clear refusal of everything else."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from protocol.errors import ConfigError
from simulators.grid_file import read_grid, write_truth
from simulators.specimen import make_specimen

FIELDS: dict[str, Any] = {
    "depth_u16": np.arange(12, dtype=np.uint16).reshape(3, 4),
    "scale_mm": 0.01,
    "z_min_mm": 10.0,
    "z_max_mm": 25.0,
    "theta0_rad": 0.5,
    "name": "bust",
}


def files(folder: Path, **changed: Any) -> tuple[Path, Path]:
    grid, image = folder / "grid.npz", folder / "texture.png"
    np.savez(grid, **{key: value for key, value in (FIELDS | changed).items() if value is not None})
    cv2.imwrite(str(image), np.full((5, 6, 3), (10, 20, 200), np.uint8))
    return grid, image


def test_a_grid_and_its_image_are_read_as_they_are(tmp_path: Path) -> None:
    specimen = make_specimen(*(files(tmp_path)[:1]), texture_path=files(tmp_path)[1])
    spec = specimen.grid.spec
    assert specimen.name == "bust"
    assert np.array_equal(specimen.grid.range_steps, FIELDS["depth_u16"])
    assert (spec.step_mm, spec.pitch_mm, spec.z_max_mm, spec.theta0_rad) == (0.01, 5.0, 25.0, 0.5)
    assert specimen.grid.texture.shape == (5, 6, 3) and tuple(specimen.grid.texture[0, 0]) == (200, 20, 10)


def test_truth_reads_back_bit_for_bit(tmp_path: Path) -> None:
    written = make_specimen("nutcracker")
    write_truth(tmp_path / "truth.npz", written.name, written.grid)
    name, grid = read_grid(tmp_path / "truth.npz", None)
    assert name == written.name
    assert np.array_equal(grid.range_steps, written.grid.range_steps)
    assert np.array_equal(grid.texture, written.grid.texture)
    assert grid.spec.pitch_mm == pytest.approx(written.grid.spec.pitch_mm, rel=1e-12)
    assert [path.name for path in tmp_path.iterdir()] == ["truth.npz"]


def test_truth_that_cannot_be_written_leaves_nothing_behind(tmp_path: Path) -> None:
    specimen = make_specimen("cylinder")
    (tmp_path / "truth.npz").mkdir()
    with pytest.raises(OSError):
        write_truth(tmp_path / "truth.npz", specimen.name, specimen.grid)
    assert [path.name for path in tmp_path.iterdir()] == ["truth.npz"]


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"depth_u16": None}, "depth_u16"),
        ({"theta0_rad": None}, "theta0_rad"),
        ({"depth_u16": np.zeros((3, 4), np.float32)}, "uint16"),
        ({"depth_u16": np.zeros(12, np.uint16)}, "dimensions"),
        ({"scale_mm": -1.0}, "step_mm"),
        ({"scale_mm": np.nan}, "step_mm"),
        ({"z_max_mm": 10.0}, "pitch_mm"),
        ({"scale_mm": np.array("fine")}, "fine"),
    ],
)
def test_a_file_that_is_no_grid_is_refused_by_name(tmp_path: Path, changed: dict[str, Any], message: str) -> None:
    grid, image = files(tmp_path, **changed)
    with pytest.raises(ConfigError, match=message):
        read_grid(grid, image)


@pytest.mark.parametrize("content", [b"", b"garbage", b"PK\x03\x04 not really"])
def test_garbage_is_refused(tmp_path: Path, content: bytes) -> None:
    grid, image = files(tmp_path)
    grid.write_bytes(content)
    with pytest.raises(ConfigError, match="no .npz grid"):
        read_grid(grid, image)


def test_a_truncated_grid_is_refused(tmp_path: Path) -> None:
    grid, image = files(tmp_path)
    grid.write_bytes(grid.read_bytes()[:-40])
    with pytest.raises(ConfigError, match="no .npz grid"):
        read_grid(grid, image)


def test_a_grid_without_texture_asks_for_one(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="--texture"):
        read_grid(files(tmp_path)[0], None)


def test_an_image_that_is_none_is_refused(tmp_path: Path) -> None:
    grid, image = files(tmp_path)
    image.write_bytes(b"not an image")
    with pytest.raises(ConfigError, match="no image"):
        read_grid(grid, image)


def test_a_generated_specimen_takes_no_texture(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="--texture"):
        make_specimen("head", texture_path=files(tmp_path)[1])
