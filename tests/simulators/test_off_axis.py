import math

import numpy as np
import pytest

from node.axis import Axis
from protocol.errors import UsageError
from protocol.grid import VOID, Grid, GridSpec
from simulators.off_axis import OffAxis, parse_off_axis, seen_off_axis
from simulators.shapes import POST_AT_RAD, POST_OFF_MM, POST_RADIUS_MM
from simulators.specimen import make_specimen
from tests.node.round_bodies import Body, seen_mm


def test_a_sensor_on_the_axis_sees_the_truth() -> None:
    truth = make_specimen("nutcracker").grid
    seen = seen_off_axis(truth, OffAxis())
    assert np.abs(seen.range_steps.astype(int) - truth.range_steps).max() <= 1
    assert np.array_equal(seen.texture, truth.texture)


@pytest.mark.parametrize("off", [OffAxis(0.8, -0.5), OffAxis(-3.0, 2.0, 0.5, -0.4)])
def test_a_post_is_seen_as_its_formula_says(off: OffAxis) -> None:
    post = make_specimen("post").grid
    x_mm, y_mm = POST_OFF_MM * math.cos(POST_AT_RAD), POST_OFF_MM * math.sin(POST_AT_RAD)
    axis = Axis(off.lateral_mm, off.radial_mm, math.radians(off.lean_deg), math.radians(off.side_deg))
    wanted_mm = seen_mm(axis, Body(POST_RADIUS_MM, x_mm, y_mm), post.spec)
    seen = seen_off_axis(post, off).range_steps
    inside = slice(3, -3)  # the truth ends at its first and last row
    assert (seen[inside] != VOID).all()
    assert np.abs(seen[inside] * post.spec.step_mm - wanted_mm[inside]).max() < 0.006


def test_what_stands_before_hides_what_is_behind() -> None:
    spec = GridSpec(360, 4, 360, 4, 0.01, 1.0)
    steps = np.full((4, 360), 3000, np.uint16)
    steps[:, 100:130] = 6000
    seen = seen_off_axis(Grid(spec, steps, np.zeros((4, 360, 3), np.uint8)), OffAxis(10.0, 0.0)).range_steps
    outer = np.flatnonzero(seen[1] > 5000)
    assert outer.min() in (89, 90) and outer.max() in (119, 120)  # ahead by asin(10 / 60), 9.6 degrees
    assert seen[1, 60] == pytest.approx(1000 * math.sqrt(8), abs=2)


def test_texture_is_what_stands_where_the_ray_ends() -> None:
    spec = GridSpec(360, 4, 720, 8, 0.01, 1.0)
    texture = np.zeros((8, 720, 3), np.uint8)
    texture[:, 200:300] = 255
    steps = np.full((4, 360), 5000, np.uint16)
    seen = seen_off_axis(Grid(spec, steps, texture), OffAxis(5.0, 0.0)).texture
    ahead = math.degrees(math.asin(0.1)) * 2
    bright = np.flatnonzero(seen[3, :, 0] > 127)
    assert bright.min() == pytest.approx(200 - ahead, abs=1) and bright.max() == pytest.approx(299 - ahead, abs=1)


@pytest.mark.parametrize("text, off", [("0.8,-0.5", OffAxis(0.8, -0.5)), ("1,2,0.5,-1", OffAxis(1, 2, 0.5, -1))])
def test_an_axis_is_told_in_mm_and_degrees(text: str, off: OffAxis) -> None:
    assert parse_off_axis(text) == off


@pytest.mark.parametrize("text", ["", "1", "1,2,3", "1,x", "1,nan", "51,0", "0,0,4,0"])
def test_no_axis_is_refused(text: str) -> None:
    with pytest.raises(UsageError, match="axis: "):
        parse_off_axis(text)
