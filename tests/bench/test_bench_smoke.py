"""The benchmarks run: one small scan, one click, a rival that needs no long search. Figures are not judged here."""

import asyncio
import json
from pathlib import Path

import numpy as np
import pytest

import foveascan
from protocol.errors import ConfigError
from tests.bench import alpha, codec, line, page, page_memory, plots, rate, roi, sphere
from tests.bench.cache import Cache
from tests.bench.rivals.offer import straight
from tests.bench.scans import BenchScan, load
from tests.bench.target import Target, Window
from tests.client.viewer.browser import GRAPHICS


@pytest.fixture(scope="module")
def scan() -> BenchScan:
    return load("head", "S")


def test_roi_compares_what_is_verified_with_what_is_verified(scan: BenchScan) -> None:
    record = roi.run([scan], "S", 1, Cache(None), ["JPEG tile pyramid"])
    assert record["verified"]
    assert record["rows"][0]["rivals"]["JPEG tile pyramid"]["size_bytes"] > 64
    assert "JPEG tile pyramid" in roi.told(record)


def test_bytes_are_drawn_against_quality(scan: BenchScan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plots, "TARGETS", (Target(texture_db=36.0), Target(texture_db=40.0)))
    monkeypatch.setattr(plots, "RIVALS", ("JPEG tile pyramid",))
    (drawn,) = plots.draw([scan], "S", tmp_path / "plots", Cache(None))
    assert drawn.read_bytes().startswith(b"\x89PNG")


def test_line_measures_every_part(scan: BenchScan) -> None:
    record = line.run(scan, 1, 1, ["S"])
    assert record["deframing"]["mb_s"] > 0
    assert {case["case"].split(",")[0] for case in record["updates"]} == {"jpeg", "htj2k"}
    assert line.told(record)


def test_rate_control_never_goes_over_a_limit(scan: BenchScan) -> None:
    record = rate.run([scan], "S", 1)
    assert record["over"] == 0
    assert rate.told(record)


def test_alpha_compares_profiles_at_equal_bytes(scan: BenchScan, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(alpha, "ALPHAS", (None, 0.1))
    monkeypatch.setattr(alpha, "CLASSIC_ALPHAS", (0.05,))
    record = alpha.run([scan], "S", 1)
    assert all(row["bytes"] <= record["limit_bytes"] for row in record["rows"])
    thin, wide, _ = record["rows"]
    assert thin["window_db"] > wide["window_db"]
    assert alpha.told(record)


def test_the_page_is_measured_beside_an_empty_one(scan: BenchScan) -> None:
    record = asyncio.run(page.run(scan, 2, 1, 1.0, "software"))
    assert record["first"]["ms"] > 0 < record["first"]["empty_ms"]
    assert record["press"]["count"] and record["click"]["ms"] < record["press"]["ms"]
    assert len(record["memory"]["mb"]["page process"]) == page_memory.ROUNDS + 1
    assert record["renderer"] in page.told(record)


def test_no_figures_of_a_processor_pass_for_a_card_s(scan: BenchScan, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(GRAPHICS, "card", GRAPHICS["software"])  # what chromium makes of it without a card
    with pytest.raises(ConfigError, match="draws WebGL by .*SwiftShader.*Vulkan driver"):
        asyncio.run(page.run(scan, 1, 1, 0.0, "card"))


def test_clicks_on_a_closed_object_reach_their_quality() -> None:
    record = sphere.run("S", 1, about=("y",))
    assert record["verified"]
    assert {row["place"] for row in record["rows"]} == set(sphere.places())
    ours = max(max(row["bytes"]) for row in record["rows"] if row["kind"] == "target")
    assert sum(record["rival_bytes"].values()) > 5 * ours
    assert "pole" in sphere.told(record)


def test_an_image_is_most_similar_to_itself() -> None:
    image = np.random.default_rng(5).normal(128, 30, (200, 150)).astype(np.float32)
    assert alpha.ms_ssim(image, image) == pytest.approx(1)
    assert alpha.ms_ssim(image, image + 40) < alpha.ms_ssim(image, image + 4) < 1


def test_codecs_meet_the_same_target(scan: BenchScan) -> None:
    record = codec.run([scan], "S", 1)
    assert all(found["db"] >= 40 for found in record["rows"][0]["texture"].values())
    assert codec.told(record)


def test_a_scan_is_turned_so_that_a_click_stays_off_the_seam(scan: BenchScan) -> None:
    click = (0.01, 0.5)
    ready, place = straight(scan, click)
    there, here = Window.round(ready.grid, place, Target()), Window.round(scan.grid, click, Target())
    assert np.array_equal(there.texels, here.texels)
    assert np.array_equal(there.range_steps, here.range_steps)


def test_the_command_prints_one_object(capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["bench", "codec", "--json", "--size", "S", "--specimen", "sphere", "--repeats", "1"]
    assert foveascan.main(arguments) == 0
    assert json.loads(capsys.readouterr().out)["conditions"]["cores"]
