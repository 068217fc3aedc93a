"""What is decided for one opening of a scan: which codec a look gets, and what is said of its result."""

from __future__ import annotations

from typing import cast

import pytest
from hypothesis import given
from hypothesis import strategies as st

from node.bound import Bound, choose_codec, updated
from node.first_view import build_first_view
from node.foveate import Update
from node.library import Scan
from node.state import ClientState
from node.texture_model import TextureModel
from node.wanted import NO_MODELS, Models, Wanted
from protocol import messages as m
from protocol.codec import TextureCodec
from protocol.lattice import Channel

BOTH: tuple[m.CodecName, ...] = ("jpeg", "htj2k")
EASY, HARD = m.Look(2, 0.75, 0.5, texture_db=35), m.Look(2, 0.75, 0.5, texture_db=55)
NOISE = 1e-9
STATE = cast("ClientState", None)  # nobody looks at it


@pytest.fixture(scope="module")
def model(scan: Scan) -> TextureModel:
    return TextureModel(scan.texture)


@pytest.mark.parametrize(
    ("codecs", "look", "chosen"),
    [
        (BOTH, EASY, "jpeg"),
        (BOTH, HARD, "htj2k"),
        (("jpeg",), HARD, "jpeg"),
        (("htj2k", "jpeg"), EASY, "htj2k"),
        (("htj2k", "jpeg"), HARD, "htj2k"),
    ],
)
def test_the_first_codec_is_taken_unless_its_best_falls_short(
    scan: Scan, model: TextureModel, codecs: tuple[m.CodecName, ...], look: m.Look, chosen: m.CodecName
) -> None:
    assert choose_codec(codecs, scan, look, model) == chosen


def test_while_nobody_knows_the_texture_the_first_codec_does_its_best(scan: Scan) -> None:
    assert choose_codec(BOTH, scan, HARD, None) == "jpeg"


@pytest.mark.parametrize("is_measured", [True, False])
@pytest.mark.parametrize(
    ("texture_db", "codec"), [(32, TextureCodec.JPEG), (36, TextureCodec.HTJ2K), (45, TextureCodec.HTJ2K)]
)
def test_a_look_gets_what_it_asks_for_whatever_the_client_likes_best(
    scan: Scan, model: TextureModel, texture_db: float, codec: TextureCodec, is_measured: bool
) -> None:
    bound = Bound(1, scan, build_first_view(scan, "jpeg", 32768).state, 2)
    look = m.Look(2, 0.75, 0.5, texture_db=texture_db)
    update = bound.plan(Wanted(look, BOTH), Models(texture=model if is_measured else None), lambda: False)
    assert isinstance(update, Update)
    assert {coded.codec for coded in update.coded if coded.channel is Channel.TEXTURE} == {codec}
    assert update.texture_db is not None and update.texture_db >= texture_db


@pytest.mark.parametrize(
    ("quick", "hurried", "texture_db", "codec"),
    [
        (True, False, 32, TextureCodec.HTJ2K),
        (False, True, 32, TextureCodec.HTJ2K),
        (True, True, 32, TextureCodec.JPEG),
        (True, True, 45, TextureCodec.HTJ2K),
    ],
)
def test_in_a_hurry_a_fast_link_gets_jpeg_where_that_does(
    scan: Scan, model: TextureModel, quick: bool, hurried: bool, texture_db: float, codec: TextureCodec
) -> None:
    bound = Bound(1, scan, build_first_view(scan, "htj2k", 32768).state, 2)
    look = m.Look(2, 0.75, 0.5, texture_db=texture_db)
    wanted = Wanted(look, ("htj2k", "jpeg"), quick=quick, hurried=hurried)
    update = bound.plan(wanted, Models(texture=model), lambda: False)
    assert isinstance(update, Update)
    assert {coded.codec for coded in update.coded if coded.channel is Channel.TEXTURE} == {codec}
    assert update.texture_db is not None and update.texture_db >= texture_db


def test_who_takes_jpeg_only_gets_its_best(scan: Scan) -> None:
    bound = Bound(1, scan, build_first_view(scan, "jpeg", 32768).state, 2)
    update = bound.plan(Wanted(HARD, ("jpeg",)), NO_MODELS, lambda: False)
    assert isinstance(update, Update) and update.texture_db is not None
    assert {coded.codec for coded in update.coded if coded.channel is Channel.TEXTURE} == {TextureCodec.JPEG}
    assert 34 < update.texture_db < HARD.texture_db


@given(st.floats(0, 1e4), st.floats(0, 100))
def test_updated_never_promises_more_than_the_truth(error_mm: float, db: float) -> None:
    said = updated(EASY, 4, Update((), STATE, "complete", error_mm, db), 0.0148765)
    assert said.error_max_mm is not None and said.texture_db is not None
    assert error_mm - NOISE <= said.error_max_mm < error_mm + 1.01e-4
    assert db - 0.0101 < said.texture_db <= db + NOISE
    assert len(repr(said.texture_db).partition(".")[2]) <= 2
    assert said.node_ms == 14.877


@pytest.mark.parametrize(
    ("error_mm", "db", "said_mm", "said_db"),
    [(51 * 0.002, 40.34999, 0.102, 40.34), (0.10201, 100.0, 0.1021, 100.0), (0.0, 40.35, 0.0, 40.35), (None,) * 4],
)
def test_updated_is_said_in_few_digits(
    error_mm: float | None, db: float | None, said_mm: float | None, said_db: float | None
) -> None:
    said = updated(EASY, 4, Update((), STATE, "complete", error_mm, db), 0.0)
    assert (said.error_max_mm, said.texture_db) == (said_mm, said_db)
