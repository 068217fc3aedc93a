from __future__ import annotations

import pytest
from imagecodecs import deflate_encode

from protocol.errors import CodecError
from protocol.inflate import inflate


def deflated(data: bytes) -> bytes:
    return bytes(deflate_encode(data, raw=True))


@pytest.mark.parametrize("data", [b"", b"x", bytes(1000)])
def test_what_was_deflated_comes_back_up_to_the_limit(data: bytes) -> None:
    assert inflate(deflated(data), len(data), "it") == data


NONSENSE = {
    "nothing": (b"", "cut short or too long"),
    "cut": (deflated(bytes(range(99)))[:-1], "cut short or too long"),
    "more behind it": (deflated(b"x") + b"y", "cut short or too long"),
    "one byte beyond the limit": (deflated(bytes(101)), "cut short or too long"),
    "a bomb": (deflated(bytes(10 << 20)), "cut short or too long"),
    "no deflate": (b"\xff\xff\xff", "does not inflate"),
}


@pytest.mark.parametrize(("payload", "why"), NONSENSE.values(), ids=NONSENSE)
def test_anything_else_is_refused_by_name(payload: bytes, why: str) -> None:
    with pytest.raises(CodecError, match=f"^the mask {why}|^the mask is {why}"):
        inflate(payload, 100, "the mask")
