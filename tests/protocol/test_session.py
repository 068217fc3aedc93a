import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol import messages as m
from protocol.errors import LocalWireError, RemoteWireError, WireError
from protocol.lattice import Channel, Parameters
from protocol.live import LiveColumns
from protocol.refinement import Generator, Refinement
from protocol.session import Phase, Role, Said, Session
from tests.protocol.test_messages import EVERY

REFINEMENT = Refinement(Generator.FOVEA, Channel.RANGE, 1, 0, 0, 0, 1, 9, b"z", b"", Parameters(2, 0, 0, 1, 1))
LIVE_COLUMNS = LiveColumns(Channel.RANGE, 1, (3,), 2, b"abcd")
SAYINGS: dict[str, Said] = {type(said).__name__: said for said in (*EVERY, REFINEMENT, LIVE_COLUMNS)}

# The table of PROTOCOL.md, "Stream", once more.
ALLOWED = {
    (Role.NODE, Phase.NEW): {"ServerInfo"},
    (Role.NODE, Phase.GREETED): {"Refused", "Goodbye"},
    (Role.NODE, Phase.WAITING): {"Welcome", "Refused", "Goodbye"},
    (Role.NODE, Phase.READY): {"Opened", "Updated", "Resync", "Published", "Refused", "Goodbye", "Refinement"}
    | {"LiveStarted", "LiveProgress", "LiveEnded", "LiveColumns", "Enveloped"},
    (Role.CLIENT, Phase.GREETED): {"Hello"},
    (Role.CLIENT, Phase.READY): {"Open", "Look", "Ack", "State", "Cancel", "Watch", "Envelope"},
}
OPENING = [(Role.NODE, "ServerInfo"), (Role.CLIENT, "Hello"), (Role.NODE, "Welcome"), (Role.NODE, "Goodbye")]
PHASES = [Phase.NEW, Phase.GREETED, Phase.WAITING, Phase.READY, Phase.CLOSED]


def joined(steps: int) -> dict[Role, Session]:
    """Two ends of one stream after some steps of OPENING."""
    ends = {role: Session(role) for role in Role}
    for speaker, name in OPENING[:steps]:
        say(ends, speaker, SAYINGS[name])
    return ends


def say(ends: dict[Role, Session], speaker: Role, said: Said) -> None:
    wire = ends[speaker].send(said)
    assert ends[other(speaker)].receive(wire) == said


def other(role: Role) -> Role:
    return Role.CLIENT if role is Role.NODE else Role.NODE


@pytest.mark.parametrize("steps", range(5))
@pytest.mark.parametrize("speaker", Role)
@pytest.mark.parametrize("name", SAYINGS)
def test_each_may_say_what_the_table_says(steps: int, speaker: Role, name: str) -> None:
    ends = joined(steps)
    assert all(end.phase is PHASES[steps] for end in ends.values())
    if name in ALLOWED.get((speaker, PHASES[steps]), set()):
        say(ends, speaker, SAYINGS[name])
        assert ends[Role.NODE].phase is ends[Role.CLIENT].phase
        return
    with pytest.raises(LocalWireError):
        ends[speaker].send(SAYINGS[name])
    said = SAYINGS[name]
    wire = said.to_bytes() if isinstance(said, Refinement | LiveColumns) else m.encode_message(said)
    with pytest.raises(RemoteWireError):
        ends[other(speaker)].receive(wire)
    assert all(end.phase is PHASES[steps] for end in ends.values()), "a refusal moved the stream on"


@given(st.lists(st.tuples(st.sampled_from(Role), st.sampled_from(sorted(SAYINGS))), max_size=30))
def test_both_ends_agree_on_the_phase_whatever_is_tried(attempts: list[tuple[Role, str]]) -> None:
    ends = joined(0)
    for speaker, name in attempts:
        try:
            say(ends, speaker, SAYINGS[name])
        except LocalWireError:
            continue
        finally:
            assert ends[Role.NODE].phase is ends[Role.CLIENT].phase


@given(st.sampled_from(Role), st.integers(0, 4), st.binary(max_size=80) | st.text(max_size=80))
def test_noise_is_refused_in_every_phase(role: Role, steps: int, noise: bytes | str) -> None:
    end = joined(steps)[role]
    with pytest.raises(WireError):
        end.receive(noise)
    assert end.phase is PHASES[steps]


def test_text_is_for_messages_and_bytes_for_samples() -> None:
    ends = joined(3)
    assert isinstance(ends[Role.NODE].send(REFINEMENT), bytes)
    assert isinstance(ends[Role.NODE].send(LIVE_COLUMNS), bytes)
    assert isinstance(ends[Role.NODE].send(m.Published("x")), str)
    with pytest.raises(RemoteWireError):
        ends[Role.CLIENT].receive(m.encode_message(m.Published("x")).encode())
