import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.errors import LocalWireError, RemoteWireError
from protocol.lattice import Channel
from protocol.live import HEADER, SAMPLE_BYTES, LiveColumns, is_live
from protocol.refinement import MAGIC as REFINEMENT_MAGIC


@st.composite
def live_columns(draw: st.DrawFn) -> LiveColumns:
    channel = draw(st.sampled_from(Channel))
    columns = draw(st.lists(st.integers(0, 65535), min_size=1, max_size=5))
    rows = draw(st.integers(1, 6))
    size_bytes = len(columns) * rows * SAMPLE_BYTES[channel]
    payload = draw(st.binary(min_size=size_bytes, max_size=size_bytes))
    return LiveColumns(channel, draw(st.integers(0, 2**32 - 1)), tuple(columns), rows, payload)


@given(live_columns())
def test_bytes_are_inverse(live: LiveColumns) -> None:
    assert LiveColumns.from_bytes(live.to_bytes()) == live
    assert is_live(live.to_bytes())


def test_samples_are_column_after_column() -> None:
    steps = np.arange(6, dtype="<u2").reshape(2, 3)
    assert np.array_equal(LiveColumns(Channel.RANGE, 1, (4, 5), 3, steps.tobytes()).samples, steps)
    texels = np.arange(18, dtype=np.uint8).reshape(2, 3, 3)
    assert np.array_equal(LiveColumns(Channel.TEXTURE, 1, (4, 5), 3, texels.tobytes()).samples, texels)


def test_the_layout_is_the_table_of_protocol_md() -> None:
    live = LiveColumns(Channel.RANGE, 0x04030201, (0x0605, 7), 1, b"\x0a\x0b\x0c\x0d")
    assert live.to_bytes().hex(" ") == "46 4c 01 00 01 02 03 04 02 00 01 00 05 06 07 00 0a 0b 0c 0d"


@given(live_columns(), st.data())
def test_cut_or_longer_bytes_are_refused(live: LiveColumns, data: st.DataObject) -> None:
    wire = live.to_bytes()
    with pytest.raises(RemoteWireError):
        LiveColumns.from_bytes(wire[: data.draw(st.integers(0, len(wire) - 1))])
    with pytest.raises(RemoteWireError):
        LiveColumns.from_bytes(wire + data.draw(st.binary(min_size=1, max_size=9)))


@pytest.mark.parametrize(
    "header",
    [
        (REFINEMENT_MAGIC, 1, 0, 1, 1, 1), (0x4C46, 2, 0, 1, 1, 1), (0x4C46, 1, 2, 1, 1, 1), (0x4C46, 1, 0, 1, 0, 1),
        (0x4C46, 1, 0, 1, 1, 0), (0x4C46, 1, 0, 1, 65535, 65535),
    ],
)  # fmt: skip
def test_other_headers_are_refused(header: tuple[int, ...]) -> None:
    with pytest.raises(RemoteWireError):
        LiveColumns.from_bytes(HEADER.pack(*header) + b"\0\0\0\0")


@pytest.mark.parametrize(
    "live",
    [
        LiveColumns(Channel.RANGE, 1, (), 1, b""),
        LiveColumns(Channel.RANGE, 1, (1,), 0, b""),
        LiveColumns(Channel.RANGE, 1, (1,), 1, b"abc"),
        LiveColumns(Channel.RANGE, 1, (65536,), 1, b"ab"),
        LiveColumns(Channel.TEXTURE, 2**32, (1,), 1, b"abc"),
    ],
)
def test_what_does_not_fit_is_not_sent(live: LiveColumns) -> None:
    with pytest.raises(LocalWireError):
        live.to_bytes()
