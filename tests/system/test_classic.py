"""The paper's letter through the public client: acceptance tests of the classic profile, with formulas of their own."""

from __future__ import annotations

import asyncio
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from client import Update, connect
from client.classic_model import ClassicModel
from client.errors import HoldingsDiffer, RequestRefused
from client.model import Applied
from client.truth import Truth
from client.update import Sent
from foveascan import main
from protocol.classic import ClassicParameters
from protocol.errors import LocalWireError
from protocol.lattice import Channel
from protocol.refinement import Refinement
from tests.system.line import RunningNode

HEADER_MAX = 64
FRAME_MAX = 10
CLICKS = [(0.45, 0.4), (0.53, 0.47), (0.02, 0.5), (0.97, 0.55), (0.5, 0.02)]
PAPER = {"range": {"alpha": 0.5, "s": 1.995}}


async def test_the_first_view_is_the_papers(head_node: RunningNode) -> None:  # AT-04, F-18
    async with connect(head_node.url) as session:
        model = await session.open(profile="classic")
        truth = head_node.truth
        assert model.coarse_range_mm.shape == (10, 20)
        assert model.coarse_texture.shape == (64, 256, 3)
        assert model.coarse_quads.shape == (180, 4)
        coarse = range_mm(truth)[::11, ::18]
        np.testing.assert_allclose(model.coarse_range_mm, coarse, atol=1e-4)
        np.testing.assert_allclose(model.range_mm, dense_bilinear(coarse, 100, 360), atol=1e-4)
        assert (model.owner == 0).all()
        texel_rows = np.linspace(0, 255, 64)
        points = np.array([bilinear_row(truth.texture, row)[::4] for row in texel_rows])
        assert np.abs(model.coarse_texture - points).max() <= 0.51


@pytest.mark.parametrize("parameters", [{"alpha": 0.5, "s": 1.995}, {"alpha": 0.1}, {"alpha": 0.5, "s": 4.61}])
async def test_vertex_data_is_n_depths_and_a_short_header(head_node: RunningNode, parameters: Any) -> None:  # AT-06
    async with connect(head_node.url) as session:
        await session.open(profile="classic")
        update = await session.look(0.5, 0.5, parameters={"range": parameters})
        alpha = parameters["alpha"]
        s = parameters.get("s", 1 / math.log1p(alpha))
        rows, columns = kept_offsets(alpha, s, 11.0, 99), kept_offsets(alpha, s, 18.0, 180)
        n = (2 * len(columns) - 1) * len([y for y in (*(-rows[1:]), *rows) if 0 <= 50 + y <= 99])
        assert update.samples == n
        assert update.payload_bytes == 2 * n
        closing_message = 200
        assert update.bytes_received - update.payload_bytes <= HEADER_MAX + FRAME_MAX + closing_message
        as_xyz = 3 * update.payload_bytes
        assert as_xyz == 3 * n * np.dtype(np.int16).itemsize


async def test_alpha_and_scale_do_what_the_paper_says(head_node: RunningNode) -> None:  # AT-07, F-01
    async with connect(head_node.url) as session:

        async def look(alpha: float, sigma: float) -> tuple[Update, np.ndarray]:
            model = await session.open(profile="classic")
            update = await session.look(0.5, 0.5, parameters={"range": {"alpha": alpha, "sigma": sigma}})
            (sent,) = update.parameters
            columns = model.positions(Channel.RANGE, fovea_of(sent))[1]
            right = columns[columns >= 180]
            growth = np.diff(right)[1:] / np.diff(right)[:-1]
            np.testing.assert_allclose(growth, math.exp(1 / fovea_of(sent).s_x), rtol=1e-9)
            return update, right

        (_, sharp), (_, flat) = await look(0.5, 0.05), await look(0.1, 0.05)
        assert sharp[1] - sharp[0] < flat[1] - flat[0]
        assert (sharp[2] - sharp[1]) / (sharp[1] - sharp[0]) > (flat[2] - flat[1]) / (flat[1] - flat[0])
        scales = [(await look(0.5, sigma))[0].samples for sigma in (0.03, 0.05, 0.1, 0.2)]
        assert scales == sorted(set(scales))


async def test_the_clicked_vertex_and_all_samples_are_the_scans(head_node: RunningNode) -> None:  # F-08, F-11
    async with connect(head_node.url) as session:
        model = await session.open(profile="classic")
        (u, v), *_ = head_node.truth.clicks(1)
        row, column = model.spec.cell_at(u, v)
        near = np.ix_(np.clip(np.arange(row - 5, row + 6), 0, 99), np.arange(column - 5, column + 6) % 360)
        true = range_mm(head_node.truth)
        before = rms(model.range_mm[near] - true[near])
        kept = model.range_mm
        update = await session.look(u, v, parameters={"range": {"alpha": 0.1}})
        assert model.range_mm[row, column] == pytest.approx(true[row, column], abs=1e-3)
        assert rms(model.range_mm[near] - true[near]) < 0.5 * before
        outside = model.owner == 0
        np.testing.assert_array_equal(model.range_mm[outside], kept[outside])
        assert outside.any() and update.changed["range"].size


async def test_the_nearest_fovea_owns_every_vertex(head_node: RunningNode) -> None:  # AT-10, F-09
    async with connect(head_node.url) as session:
        model = await session.open(profile="classic")
        distance = np.full((100, 360), np.inf)
        owner = np.zeros((100, 360), int)
        row, column = np.mgrid[:100, :360]
        for number, (u, v) in enumerate(CLICKS * 2, 1):
            update = await session.look(u, v, parameters={"range": {"alpha": 0.1 if u < 0.5 else 0.3}})
            away_x = (column - int(u * 360) + 180) % 360 - 180
            away_y = row - int(v * 100)
            if number > len(CLICKS):
                assert update.samples == 0  # the same click again
                continue
            y, x = model.positions(Channel.RANGE, fovea_of(update.parameters[0]))
            middle = int(u * 360)
            inside = (away_y + int(v * 100) >= y[0]) & (away_y + int(v * 100) <= y[-1])
            right = np.where(away_x < x[0] - middle, away_x + 360, away_x)
            inside &= (right + middle >= x[0]) & (right + middle <= x[-1])
            new = np.abs(away_x) + np.abs(away_y)
            won = inside & (new < distance)
            distance[won], owner[won] = new[won], number
        np.testing.assert_array_equal(model.owner, owner)
        assert len(np.unique(owner)) > len(CLICKS)
        assert session.stats.resyncs == 0


async def test_texture_gets_sharper_round_the_click(line: Callable[..., RunningNode]) -> None:  # AT-13, F-12
    node = await asyncio.to_thread(line, "--specimen", "cylinder")
    async with connect(node.url) as session:
        for u, v in node.truth.clicks(4):
            model = await session.open(profile="classic")
            before = psnr(model, node.truth, u, v)
            update = await session.look(u, v, parameters={"texture": {"alpha": 0.03, "q": 75}})
            assert psnr(model, node.truth, u, v) >= before + 4
            assert update.parameters[0].quality == 75


@pytest.mark.parametrize("max_bytes", [0, 300, 1000, 3000, 6000])
async def test_the_largest_scale_that_fits_is_taken_and_never_a_byte_more(
    head_node: RunningNode, max_bytes: int
) -> None:  # AT-12 classic, F-14
    async with connect(head_node.url) as session:
        await session.open(profile="classic")
        update = await session.look(0.5, 0.5, max_bytes=max_bytes)
        assert update.reason == "byte limit"
        if update.samples:
            assert update.bytes_received <= max_bytes
        if max_bytes >= 1000:
            assert {sent.channel for sent in update.parameters} == {"range", "texture"}
            assert update.bytes_received >= 0.75 * max_bytes


async def test_a_session_keeps_to_the_profile_it_was_opened_with(head_node: RunningNode) -> None:
    async with connect(head_node.url) as session:
        await session.open()
        with pytest.raises(LocalWireError, match="profile"):
            await session.look(0.5, 0.5, profile="classic")
        await session.open(profile="classic")
        with pytest.raises(LocalWireError, match="profile"):
            await session.look(0.5, 0.5, profile="default")
        with pytest.raises(LocalWireError, match="owners"):
            session.holdings("range")
        for wrong in ({"s": 2.0, "sigma": 0.5}, {"alpha": 0.005, "s": 9999.0}):
            with pytest.raises(RequestRefused):
                await session.look(0.5, 0.5, profile="classic", parameters={"range": wrong})
        assert (await session.look(0.5, 0.5, parameters=PAPER)).samples == 143
        model = await session.open()
        assert not isinstance(model, ClassicModel)
        assert (await session.look(0.5, 0.5)).reason == "complete"


async def test_a_fovea_that_was_not_taken_in_is_sent_again(
    head_node: RunningNode, monkeypatch: pytest.MonkeyPatch
) -> None:  # B.3
    async with connect(head_node.url) as session:
        model = await session.open(profile="classic")
        await session.look(0.3, 0.5, parameters=PAPER)
        with monkeypatch.context() as patch:
            patch.setattr(ClassicModel, "apply", disagree)
            assert (await session.look(0.5, 0.5, parameters=PAPER)).lost == 1
        assert (await session.look(0.5, 0.5, parameters=PAPER)).samples == 143
        assert (await session.look(0.3, 0.5, parameters=PAPER)).samples == 0
        assert np.unique(model.owner).tolist() == [0, 1, 3]
        assert session.stats.resyncs == 1


def test_the_command_looks_by_the_papers_letter(
    head_node: RunningNode, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    look = ["look", "--node", head_node.url, "--profile", "classic", "--at", "0.5,0.5", "--json"]
    assert main([*look, "-o", str(tmp_path / "model.npz")]) == 0
    opened, update = (json.loads(line) for line in capsys.readouterr().out.splitlines())
    assert opened["first_view_bytes"] > 2 * 200
    assert update["samples"] > 2257
    assert (tmp_path / "model.npz").exists()


def disagree(model: ClassicModel, refinement: Refinement) -> Applied:
    raise HoldingsDiffer("as if something had got lost")


def range_mm(truth: Truth) -> np.ndarray:
    return np.where(truth.range_steps == 0, np.nan, truth.range_steps * truth.step_mm)


def dense_bilinear(coarse: np.ndarray, height: int, width: int) -> np.ndarray:
    """Cyclic in x, rows with inclusive ends; a corner counts only where its weight is not 0."""
    rows, columns = coarse.shape
    dense = np.zeros((height, width))
    for row in range(height):
        for column in range(width):
            y, x = row * (rows - 1) / (height - 1), column * columns / width
            for j, wy in ((math.floor(y), 1 - y % 1), (math.ceil(y), y % 1)):
                for i, wx in ((math.floor(x), 1 - x % 1), (math.floor(x) + 1, x % 1)):
                    if wy * wx:
                        dense[row, column] += wy * wx * coarse[j, i % columns]
    return dense


def bilinear_row(image: np.ndarray, row: float) -> np.ndarray:
    low = math.floor(row)
    part = row - low
    return np.asarray((1 - part) * image[low] + part * image[min(low + 1, image.shape[0] - 1)])


def kept_offsets(alpha: float, s: float, coarse: float, reach: float) -> np.ndarray:
    """Rings from the fovea outward while they stand no further apart than the first view's samples (eq. 12)."""
    alpha, s = float(np.float32(alpha)), float(np.float32(s))
    rings = [0.0]
    while True:
        ring = math.expm1(len(rings) / s) / alpha
        if ring - rings[-1] > coarse or ring > reach:
            return np.array(rings)
        rings.append(ring)


def fovea_of(sent: Sent) -> ClassicParameters:
    assert isinstance(sent.parameters, ClassicParameters)
    return sent.parameters


def rms(difference: np.ndarray) -> float:
    return float(np.sqrt(np.nanmean(difference**2)))


def psnr(model: ClassicModel, truth: Truth, u: float, v: float) -> float:
    """Over the 33 x 33 texels round a click."""
    height, width = truth.texture.shape[:2]
    rows = np.clip(np.arange(-16, 17) + int(v * height), 0, height - 1)
    columns = (np.arange(-16, 17) + int(u * width)) % width
    difference = model.texture[np.ix_(rows, columns)].astype(float) - truth.texture[np.ix_(rows, columns)]
    return 10 * math.log10(255**2 / np.mean(difference**2))
