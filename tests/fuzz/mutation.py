"""Bytes that are nearly right: edits of valid ones, as hypothesis draws them or a seeded generator does."""

from __future__ import annotations

import random
from collections.abc import Sequence
from typing import NamedTuple

from hypothesis import strategies as st

EDITS_MAX = 8
PIECE_MAX = 64
ODD = (
    b"", b"\0", b"\xff", b"\xff" * 4, b"\0" * 8, b"\x7f\xff\xff\xff", b"\x80", b"-1", b"0", b"1e309", b"NaN", b"null",
    b"[]", b"{}", b'"', b"\n", b"\r\n", b"%00", b"../", b"9" * 40, "ä".encode(), b"\xed\xa0\x80", b"true", b"[" * 60,
)  # fmt: skip


class Edit(NamedTuple):
    """At a share `at` of the bytes: put `piece` over what is there, in between, or for the rest of it."""

    kind: str
    at: float
    piece: bytes


KINDS = ("over", "insert", "cut", "double", "end")


def edited(data: bytes, edits: Sequence[Edit]) -> bytes:
    """What edits make of data."""
    for kind, share, piece in edits:
        at = int(share * len(data))
        match kind:
            case "over":
                data = data[:at] + piece + data[at + len(piece) :]
            case "insert":
                data = data[:at] + piece + data[at:]
            case "cut":
                data = data[:at] + data[at + len(piece) + 1 :]
            case "double":
                data = data[:at] + data[at : at + 4 * len(piece)] + data[at:]
            case _:
                data = data[:at]
    return data


def mutants(seeds: Sequence[bytes]) -> st.SearchStrategy[bytes]:
    """For hypothesis: mostly edited seeds, now and then anything at all."""
    piece = st.sampled_from(ODD) | st.binary(max_size=PIECE_MAX)
    edit = st.builds(Edit, st.sampled_from(KINDS), st.floats(0, 1), piece)
    nearly = st.builds(edited, st.sampled_from(list(seeds)), st.lists(edit, max_size=EDITS_MAX))
    return st.one_of(nearly, nearly, nearly, st.binary(max_size=256))


def mutant(seeds: Sequence[bytes], draw: random.Random) -> bytes:
    """The same, from a seeded generator: quicker, for the hundred thousand messages of a port."""
    if draw.random() < 0.2:
        return draw.randbytes(draw.randrange(256))
    pieces = (lambda: draw.choice(ODD), lambda: draw.randbytes(draw.randrange(PIECE_MAX)))
    count = draw.randrange(EDITS_MAX)
    edits = [Edit(draw.choice(KINDS), draw.random(), draw.choice(pieces)()) for _ in range(count)]
    return edited(draw.choice(seeds), edits)
