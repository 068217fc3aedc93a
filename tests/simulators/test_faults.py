import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.errors import ConfigError
from protocol.framing import Frame, FrameReader, encode_frame
from simulators.faults import FAULT_NAMES, Faults, parse_faults, split_frames
from simulators.flaws import Flaws


def test_faults_and_flaws_are_told_apart() -> None:
    faults, flaws = parse_faults("loss=0.25, spikes=0.5,reset,reversed,dead=3", seed=9)
    assert faults == Faults(loss=0.25, reset=1.0)
    assert flaws == Flaws(seed=9, spikes=0.5, is_reversed=True, dead_rows=3)


@pytest.mark.parametrize("name", FAULT_NAMES)
def test_every_name_is_understood(name: str) -> None:
    assert parse_faults(f"{name}=1") != (Faults(), Flaws())


@pytest.mark.parametrize(
    "text",
    [
        "rain", "loss=much", "loss=-1", "loss=inf", "loss=nan", "flip=2", "loss=0.1,loss=0.2", "dead=1.5",
        "dead=100000", "dribble=0", "reset=2", "slip=1.1", "stall=1e9",
    ],
)  # fmt: skip
def test_what_makes_no_sense_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="^faults: "):
        parse_faults(text)


@given(st.lists(st.binary(max_size=100), max_size=8))
def test_frames_are_cut_where_they_begin(payloads: list[bytes]) -> None:
    frames = [encode_frame(0x24, payload, seq=n, session=3) for n, payload in enumerate(payloads)]
    assert list(split_frames(b"".join(frames))) == frames
    reader = FrameReader()
    for frame in frames:
        reader.receive_data(frame)
        assert isinstance(reader.next_event(), Frame)
