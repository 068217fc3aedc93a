from pathlib import Path

import numpy as np
import pytest

from node.classic import (
    ClassicCoded,
    ClassicState,
    ClassicView,
    build_classic_view,
    code_classic_range,
    code_classic_texture,
    point_range,
    point_texture,
    replicate_edges,
)
from node.library import Scan
from protocol.classic import ClassicLattice, ClassicParameters, Foveae, build_classic, kept_samples, single
from protocol.codec import decode_texture
from protocol.errors import LatticeError
from protocol.grid import Grid, GridSpec
from protocol.lattice import Channel
from protocol.refinement import CRC, HEADER, Refinement
from tests.node.scans import keep

ALPHA = single(0.5)
S = single(2.4)


@pytest.fixture(scope="module")
def view(scan: Scan) -> ClassicView:
    return build_classic_view(scan, "htj2k")


def fovea(x: int, y: int, number: int = 1) -> ClassicParameters:
    return ClassicParameters(number, x, y, ALPHA, ALPHA, S, S)


def test_the_first_view_is_points_of_the_scan(scan: Scan, view: ClassicView) -> None:
    shape = view.state.shapes[Channel.RANGE]
    assert (view.info.profile, view.info.coarse_width, view.info.coarse_height) == ("classic", 9, 10)
    steps = np.frombuffer(view.range.payload, "<u2").reshape(10, 9)
    assert steps[0, 0] == scan.range_steps[0, 0] and steps[9, 0] == scan.range_steps[95, 0]
    assert view.range.samples == shape.coarse_width * shape.coarse_height == steps.size
    texels = decode_texture(view.texture.payload, view.texture.codec, view.texture.quality, (96, 160))  # type: ignore[arg-type]
    np.testing.assert_array_equal(texels[0], scan.texture[0, ::4])
    np.testing.assert_array_equal(texels[95], scan.texture[-1, ::4])


@pytest.mark.parametrize("codec", ["htj2k", "jpeg"])
def test_the_first_view_travels_in_any_opening(scan: Scan, codec: str) -> None:
    view = build_classic_view(scan, codec)  # type: ignore[arg-type]
    first, second = (Refinement.from_bytes(data) for data in view.refinements(7))
    assert (first.epoch, first.seq, second.epoch, second.seq) == (7, 0, 7, 1)
    assert first.payload == view.range.payload and second.payload == view.texture.payload


def test_depths_travel_alone_behind_a_short_header(scan: Scan, view: ClassicView) -> None:  # F-13
    coded = code_classic_range(scan, Foveae(), view.state.shapes[Channel.RANGE], fovea(100, 40))
    assert coded is not None
    wire = coded.refinement(1, 2, 3).to_bytes()
    assert len(coded.payload) == 2 * coded.samples
    assert len(wire) - len(coded.payload) == HEADER.size + 22 + CRC.size <= 64
    back = Refinement.from_bytes(wire)
    assert (back.parameters, back.samples) == (fovea(100, 40), coded.samples)
    assert isinstance(coded.lattice, ClassicLattice)
    assert coded.samples == coded.lattice.x.size * coded.lattice.y.size


def test_depths_are_the_scans_at_whole_positions_and_between_neighbours_elsewhere(scan: Scan) -> None:  # F-08
    steps = scan.range_steps.astype(float)
    values = point_range(scan, np.array([3.0, 3.5, 95.0]), np.array([-0.5, 0.0, 159.5]))
    assert values[0, 1] == steps[3, 0] and values[2, 1] == steps[95, 0]
    assert values[1, 1] == np.rint((steps[3, 0] + steps[4, 0]) / 2)
    assert values[0, 0] == values[0, 2] == np.rint((steps[3, 159] + steps[3, 0]) / 2)


def test_a_hole_among_the_neighbours_is_a_hole(scan: Scan) -> None:
    (top, left), *_ = np.argwhere(scan.range_steps == 0)
    beside = point_range(scan, np.array([top - 1.0, top - 0.5, float(top)]), np.array([float(left)]))
    assert beside[0, 0] > 0 and beside[1, 0] == beside[2, 0] == 0


def test_the_same_fovea_again_owns_nothing(scan: Scan, view: ClassicView) -> None:
    shapes = view.state.shapes
    first = code_classic_range(scan, Foveae(), shapes[Channel.RANGE], fovea(100, 40))
    second = code_classic_texture(scan, Foveae(), shapes[Channel.TEXTURE], fovea(400, 160), 75)
    assert first is not None and second is not None
    held = second.held_by(first.held_by(Foveae()))
    assert code_classic_range(scan, held, shapes[Channel.RANGE], fovea(100, 40, 2)) is None
    assert code_classic_texture(scan, held, shapes[Channel.TEXTURE], fovea(400, 160, 2), 75) is None


def test_a_second_fovea_sends_only_what_it_owns(scan: Scan, view: ClassicView) -> None:
    shape = view.state.shapes[Channel.RANGE]
    first = code_classic_range(scan, Foveae(), shape, fovea(100, 40))
    assert first is not None
    second = code_classic_range(scan, first.held_by(Foveae()), shape, fovea(110, 43, 2))
    alone = code_classic_range(scan, Foveae(), shape, fovea(110, 43, 2))
    assert second is not None and alone is not None
    assert second.samples < alone.samples
    assert isinstance(second.lattice, ClassicLattice)
    kept = kept_samples(second.lattice, second.claimed)
    np.testing.assert_array_equal(values(second), values(alone)[kept.ravel()])


def test_discarded_texels_repeat_the_edge() -> None:
    kept = np.array([[0, 1, 0, 1, 0], [0, 0, 0, 0, 0], [1, 1, 0, 0, 0]], bool)
    patch = np.arange(15, dtype=np.uint8).reshape(3, 5)[..., None].repeat(3, axis=2)
    filled = replicate_edges(patch, kept)[..., 0]
    np.testing.assert_array_equal(filled, [[1, 1, 1, 3, 3], [1, 1, 1, 3, 3], [10, 11, 11, 11, 11]])


def test_the_state_goes_back_to_what_a_client_has(scan: Scan, view: ClassicView) -> None:
    shape = view.state.shapes[Channel.RANGE]
    coded = code_classic_range(scan, Foveae(), shape, fovea(100, 40))
    assert coded is not None
    later = ClassicState(view.state.shapes, coded.held_by(Foveae()), 1)
    assert later.at(3).holdings == later.holdings
    assert later.at(2).holdings == Foveae()
    for nonsense in (1, 4):
        with pytest.raises(LatticeError):
            later.at(nonsense)


@pytest.mark.parametrize("size", [(8, 1), (1, 8), (8, 9)])
def test_small_and_empty_scans(size: tuple[int, int], tmp_path: Path) -> None:
    width, height = size
    spec = GridSpec(width, height, 2 * width, 2 * height, 0.01, 0.5)
    texture = np.full((2 * height, 2 * width, 3), 9, np.uint8)
    scan = keep(Grid(spec, np.zeros((height, width), np.uint16), texture), tmp_path)
    view = build_classic_view(scan, "jpeg")
    coded = code_classic_range(scan, Foveae(), view.state.shapes[Channel.RANGE], fovea(0, height - 1))
    assert coded is not None and not any(coded.payload)
    colour = code_classic_texture(scan, Foveae(), view.state.shapes[Channel.TEXTURE], fovea(0, 0), 75)
    assert colour is not None and colour.samples >= 1


def test_texture_points_are_bilinear(scan: Scan) -> None:
    found = point_texture(scan, np.array([10.5]), np.array([639.5]))[0, 0]
    corners = scan.texture[10:12][:, [639, 0]].astype(float)
    assert np.abs(found - corners.mean((0, 1))).max() <= 0.51


def test_lattices_are_the_ones_that_travel(view: ClassicView) -> None:
    shape = view.state.shapes[Channel.RANGE]
    travelled = ClassicParameters.from_bytes(fovea(100, 40).to_bytes())
    assert build_classic(shape, travelled) is build_classic(shape, fovea(100, 40))


def values(coded: ClassicCoded) -> np.ndarray:
    return np.frombuffer(coded.payload, "<u2")
