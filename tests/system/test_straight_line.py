"""A sweep becomes a model on another machine: acceptance tests of the default profile, through the public client."""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path

import aiohttp
import msgspec
import numpy as np
import pytest

from client import Model, Update, connect, discover
from client.errors import RequestRefused
from foveascan import started
from node.foveate import REPLY_BYTES
from protocol import messages as m
from protocol.errors import LocalWireError
from protocol.lattice import QUARTERS, Parameters, build_lattice
from tests.system.line import SHARED_DATA, RunningNode, surveyed

EXACT = {"range": {"p": 1, "quantum": 1}}
LOSSLESS = {"range": {"p": 1, "quantum": 1}, "texture": {"p": 1, "quality": 255}}
SHARP = {"range": {"p": 1, "quantum": 1}, "texture": {"p": 1, "quality": 80}}
RANGE_BLOCK = 8
FIRST_VIEW_MAX = 32 * 1024
SOON_S = 30.0  # AT-01 has 5 s on a machine that is not loaded


async def test_discovered_soon_and_gone_soon_after_sigterm(tmp_path: Path) -> None:  # AT-01
    name = f"at-01-{tmp_path.name}"
    serve = ["serve", "--library", str(tmp_path), "--listen", "127.0.0.1:0", "--insecure", "--json", "--name", name]
    with started(*serve) as (process, ready):
        found = await discover(SOON_S, name)
        assert [node.url for node in found] == [ready["url"]]
        began = time.monotonic()
        process.terminate()
        assert await asyncio.to_thread(process.wait, SOON_S) == 0
        while await discover(0.5, name):
            assert time.monotonic() - began < SOON_S


async def test_first_view_is_small_and_whole(head_node: RunningNode) -> None:  # AT-04, default
    async with connect(head_node.url) as session:
        model = await session.open()
        assert session.stats.bytes_received <= FIRST_VIEW_MAX
        truth = head_node.truth.range_steps
        both = (model.range_steps > 0) & (truth > 0)
        assert both.sum() > 0.97 * (truth > 0).sum()
        error_mm = np.abs(model.range_steps[both].astype(int) - truth[both]) * head_node.truth.step_mm
        assert np.median(error_mm) < 1.0
        assert (model.spacing == 8).all()


async def test_a_look_reaches_the_quality_and_touches_nothing_else(head_node: RunningNode) -> None:  # AT-05, AT-13
    async with connect(head_node.url) as session:
        model = await session.open()
        for u, v in head_node.truth.clicks(3):
            before = model.range_steps.copy()
            update = await session.look(u, v)
            compared = head_node.truth.compare(model, u, v)
            assert update.reason == "complete"
            assert compared["ok"], compared
            assert_untouched_outside(update, before, model)
            assert_sample_nearest_click(update, model, head_node, u, v)


async def test_explicit_spacing_1_is_exact(head_node: RunningNode) -> None:  # AT-05
    async with connect(head_node.url) as session:
        model = await session.open()
        (u, v), *_ = head_node.truth.clicks(1)
        row, column = model.spec.cell_at(u, v)
        near = near_cells(row, column, *model.range_steps.shape)
        coarse = rmse(model, head_node, near)
        await session.look(u, v, parameters=EXACT)
        assert model.range_steps[row, column] == head_node.truth.range_steps[row, column]
        assert rmse(model, head_node, near) <= 0.25 * coarse


async def test_turned_object_gives_the_turned_model(
    line: Callable[..., RunningNode], tmp_path: Path, head_node: RunningNode
) -> None:  # AT-08
    columns = 72
    turned_file = tmp_path / "turned.npz"
    width = head_node.truth.range_steps.shape[1]
    with np.load(head_node.folder / "truth.npz") as file:
        turned = {key: file[key] for key in file.files}
    turned["depth_u16"] = np.roll(turned["depth_u16"], columns, axis=1)
    np.savez(turned_file, **turned)
    turned_node = await asyncio.to_thread(line, "--specimen", str(turned_file))
    (u, v), *_ = head_node.truth.clicks(1)
    grids = []
    for node, at in ((head_node, u), (turned_node, (u + columns / width) % 1)):
        async with connect(node.url) as session:
            model = await session.open()
            await session.look(at, v, parameters={"range": {"p": 2, "quantum": 3}})
            grids.append(model.range_steps.copy())
    np.testing.assert_array_equal(np.roll(grids[0], columns, axis=1), grids[1])


async def test_same_click_twice_sends_nothing_and_order_does_not_matter(head_node: RunningNode) -> None:  # AT-09
    first, second = (0.45, 0.4), (0.53, 0.47)
    results = []
    for order in ((first, second), (second, first)):
        async with connect(head_node.url) as session:
            model = await session.open()
            for place in order:
                await session.look(*place, parameters=EXACT)
            again = await session.look(*order[0], parameters=EXACT)
            assert again.samples == 0
            assert again.payload_bytes == 0
            results.append((session.holdings("range").level, model.range_steps.copy()))
    np.testing.assert_array_equal(results[0][0], results[1][0])
    exact = np.kron(results[0][0] == 0, np.ones((RANGE_BLOCK, RANGE_BLOCK), bool))[: results[0][1].shape[0]]
    np.testing.assert_array_equal(results[0][1][exact], results[1][1][exact])


async def test_no_level_rises_over_50_looks_and_level_0_keeps_its_promise(head_node: RunningNode) -> None:  # AT-11
    random = np.random.default_rng(11)
    async with connect(head_node.url) as session:
        model = await session.open()
        levels = {channel: session.holdings(channel) for channel in ("range", "texture")}
        for _ in range(50):
            p, quantum = int(random.choice([1, 2, 4])), int(random.choice([1, 5, 40]))
            explicit = {"range": {"p": p, "quantum": quantum}, "texture": {"p": p, "quality": 40 + 5 * p}}
            await session.look(*random.random(2), parameters=explicit if random.random() < 0.7 else None)
            for channel, before in levels.items():
                held = session.holdings(channel)  # type: ignore[arg-type]
                assert (held.level <= before.level).all()
                assert (held.rank[held.level == before.level] >= before.rank[held.level == before.level]).all()
                levels[channel] = held
        held = levels["range"]
        shape = model.range_steps.shape
        level, rank = (np.kron(a, np.ones((RANGE_BLOCK, RANGE_BLOCK), int))[: shape[0], : shape[1]] for a in held)
        error = np.abs(model.range_steps.astype(int) - head_node.truth.range_steps)
        quantum_held = 65535 - rank
        assert (error[level == 0] <= quantum_held[level == 0] // 2).all()
        assert (level == 0).any()
        assert session.stats.resyncs == 0


async def test_three_clients_have_holdings_of_their_own_and_a_stalled_one_harms_nobody(head_node: RunningNode) -> None:
    async with connect(head_node.url) as one, connect(head_node.url) as two, stalled_client(head_node.url):  # AT-35
        for session in (one, two):
            await session.open()
        await one.look(0.3, 0.5, parameters=EXACT)
        await two.look(0.7, 0.5, parameters=EXACT)
        assert (one.holdings("range").level == 0).any()
        assert (two.holdings("range").level == 0).any()
        assert not ((one.holdings("range").level == 0) & (two.holdings("range").level == 0)).any()


async def test_a_newer_look_supersedes_older_ones(head_node: RunningNode) -> None:
    async with connect(head_node.url) as session:
        await session.open()
        looks = [asyncio.create_task(session.look(0.1 * n, 0.5, parameters=SHARP)) for n in range(8)]
        updates = await asyncio.gather(*looks)
        assert updates[-1].reason == "complete"
        assert {update.reason for update in updates[1:-1]} <= {"superseded", "complete"}
        assert "superseded" in {update.reason for update in updates}


async def test_the_error_envelope_holds_every_block(head_node: RunningNode) -> None:
    async with connect(head_node.url) as session:
        model = await session.open()
        for _ in range(2):
            error = np.abs(model.range_steps.astype(int) - head_node.truth.range_steps) * head_node.truth.step_mm
            error[head_node.truth.range_steps == 0] = 0
            starts = [np.arange(0, size, RANGE_BLOCK) for size in error.shape]
            blocks = np.maximum.reduceat(np.maximum.reduceat(error, starts[0], axis=0), starts[1], axis=1)
            np.testing.assert_allclose(await session.error_envelope(), blocks, atol=1e-4)
            await session.look(0.5, 0.5)


@pytest.mark.parametrize("max_bytes", [0, 300, 1000, 3000, 8000])
async def test_never_a_byte_over_the_limit(head_node: RunningNode, max_bytes: int) -> None:  # AT-12, explicit limits
    async with connect(head_node.url) as session:
        await session.open()
        for u, v in head_node.truth.clicks(3):
            update = await session.look(u, v, max_bytes=max_bytes)
            if update.samples:
                assert update.bytes_received <= max_bytes
            else:
                assert update.reason == "byte limit"
                assert 0 < update.bytes_received <= REPLY_BYTES, "the floor that PROTOCOL names"


async def test_the_joint_choice_beats_a_fixed_quality_at_five_budgets(head_node: RunningNode) -> None:  # AT-38
    click, fixed = head_node.truth.clicks(1)[0], 36
    gains = []
    async with connect(head_node.url) as session:
        await session.open()
        await surveyed(head_node.url)
        whole = (await session.look(*click, texture_db=44)).bytes_received
        for share in (0.3, 0.45, 0.6, 0.75, 0.9):
            budget = round(share * whole)
            model = await session.open()
            update = await session.look(*click, texture_db=44, max_bytes=budget)
            assert update.bytes_received <= budget
            ours_db = head_node.truth.compare(model, *click)["texture_psnr_db"]
            ranges = [sent for sent in update.parameters if sent.channel == "range"]
            same_range = {"p": int(ranges[0].p), "quantum": ranges[0].quality}
            for p in (1, 2, 4, 8):  # the finest that fits
                model = await session.open()
                held_db = head_node.truth.compare(model, *click)["texture_psnr_db"]
                parameters = {"range": same_range, "texture": {"p": p, "quality": fixed}}
                update = await session.look(*click, max_bytes=budget, parameters=parameters)
                if len(update.parameters) == 2:
                    held_db = head_node.truth.compare(model, *click)["texture_psnr_db"]
                    break
            gains.append(ours_db - held_db)
    assert min(gains) >= -0.2
    assert np.mean(gains) > 0


async def test_a_click_outside_the_scan_is_refused_and_the_session_goes_on(head_node: RunningNode) -> None:
    async with connect(head_node.url) as session:
        await session.open()
        for u, v in ((1.0, 0.5), (-0.1, 0.5), (0.5, math.nan), (math.inf, 0.5)):
            with pytest.raises(LocalWireError, match="look"):
                await session.look(u, v)
        with pytest.raises(RequestRefused, match="no such scan|not found|unknown"):
            await session.open("0" * 32)
        assert (await session.look(0.5, 0.5, parameters=EXACT)).samples > 0


@pytest.mark.skipif(not SHARED_DATA.is_dir(), reason="needs the real scans of ../shared/data")
@pytest.mark.parametrize("name", ["lps_head", "mustard", "james"])
async def test_real_scans_at_s(name: str, line: Callable[..., RunningNode]) -> None:
    folder = SHARED_DATA / name
    texture = folder / f"{name}_tex_1024x256.png"
    depth = folder / f"{name}_depth_360x100.npz"
    node = await asyncio.to_thread(line, "--specimen", str(depth), "--texture", str(texture))
    async with connect(node.url) as session:
        model = await session.open()
        assert session.stats.bytes_received <= FIRST_VIEW_MAX
        for u, v in node.truth.clicks(3):
            before = model.range_steps.copy()
            update = await session.look(u, v)
            compared = node.truth.compare(model, u, v)
            assert compared["ok"], compared
            assert_untouched_outside(update, before, model)
            assert_sample_nearest_click(update, model, node, u, v)


@asynccontextmanager
async def stalled_client(url: str) -> AsyncIterator[None]:
    """A client that asks for everything, losslessly, and never reads a byte of it."""
    everything = m.Look(2, 0.5, 0.5, window=1.0, parameters=msgspec.convert(LOSSLESS, m.LookParameters))
    async with aiohttp.ClientSession() as http, http.ws_connect(f"{url}/v1/stream", protocols=[m.PROTOCOL]) as socket:
        for message in (m.Hello(m.PROTOCOL), m.Open(1, "latest"), everything):
            await socket.send_str(m.encode_message(message))
        yield


def assert_untouched_outside(update: Update, before: np.ndarray, model: Model) -> None:
    """Range of every block that the update did not adopt is as it was."""
    rows, columns = model.shapes[0].blocks  # type: ignore[index]
    changed = np.zeros(rows * columns, bool)
    changed[update.changed["range"]] = True
    cells = np.kron(changed.reshape(rows, columns), np.ones((RANGE_BLOCK, RANGE_BLOCK), bool))
    kept = ~cells[: before.shape[0], : before.shape[1]]
    np.testing.assert_array_equal(model.range_steps[kept], before[kept])


def assert_sample_nearest_click(update: Update, model: Model, node: RunningNode, u: float, v: float) -> None:
    """At the reported lattice sample nearest to the click, range is the scan's within half the update's step, unless
    the block there was held well enough and left alone."""
    sent = next(sent for sent in update.parameters if sent.channel == "range")
    lattice = build_lattice(model.shapes[0], sent.parameters)  # type: ignore[index]
    row, column = model.spec.cell_at(u, v)
    width = model.spec.width
    samples_y, samples_x = lattice.y.at // QUARTERS, lattice.x.at // QUARTERS
    y = int(samples_y[np.argmin(np.abs(samples_y - row))])
    x = int(samples_x[np.argmin(np.abs((samples_x - column + width // 2) % width - width // 2))]) % width
    held, true = int(model.range_steps[y, x]), int(node.truth.range_steps[y, x])
    block = y // RANGE_BLOCK * model.shapes[0].blocks[1] + x // RANGE_BLOCK  # type: ignore[index]
    is_listed = isinstance(sent.parameters, Parameters) and sent.parameters.listed is not None
    left_alone = is_listed and block not in update.changed["range"]
    assert true == 0 or left_alone or abs(held - true) <= sent.quality // 2
    assert (held == 0) == (true == 0)


def near_cells(row: int, column: int, height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Cells within an L1 distance of 5, cyclic in x."""
    rows, columns = np.mgrid[-5:6, -5:6]
    near = np.abs(rows) + np.abs(columns) <= 5
    rows, columns = row + rows[near], (column + columns[near]) % width
    inside = (rows >= 0) & (rows < height)
    return rows[inside], columns[inside]


def rmse(model: Model, node: RunningNode, cells: tuple[np.ndarray, np.ndarray]) -> float:
    """Root mean square of the range error over cells measured in both. [steps]"""
    held, true = model.range_steps[cells].astype(float), node.truth.range_steps[cells].astype(float)
    measured = (held > 0) & (true > 0)
    return float(np.sqrt(np.mean((held - true)[measured] ** 2)))

