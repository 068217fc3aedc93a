"""Host and device are joined, so that every test runs both roles; the time is a number."""

import itertools
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.errors import LocalWireError
from protocol.framing import Dropped, DropReason, Flag, encode_frame
from protocol.grid import GridSpec
from protocol.scanner_link import (
    RETRY_MAX_S,
    RETRY_MIN_S,
    TRIES,
    Accepted,
    Command,
    Event,
    Refused,
    Role,
    ScannerLink,
    Sent,
    Unanswered,
    WrongVersion,
)
from protocol.scanner_messages import (
    Calibrate,
    Calibration,
    Credit,
    DeviceInfo,
    Hello,
    NakCode,
    RangeColumn,
    Reset,
    State,
    Status,
    SweepHeader,
    SweepRequest,
    SweepStart,
    encode_message,
)

INFO = DeviceInfo("A7", 5, 1000, 100)
WINDOW = 4096
Line = Callable[[bytes], bytes]


def column(n: int = 0, size: int = 100) -> RangeColumn:
    return RangeColumn(1, 0, n, 0, n, n, bytes(size))


def drain(link: ScannerLink) -> list[Event]:
    found = []
    while (event := link.next_event()) is not None:
        found.append(event)
    return found


def deadline_s(link: ScannerLink) -> float:
    deadline = link.next_deadline()
    assert deadline is not None
    return deadline


def only_command(found: list[Event]) -> Command:
    (command,) = found
    assert isinstance(command, Command)
    return command


class Joined:
    """Two ends and the line between them."""

    def __init__(self, *, session: int = 7, greeted: bool = True) -> None:
        self.host = ScannerLink(Role.HOST, session=session, window_bytes=WINDOW)
        self.device = ScannerLink(Role.DEVICE, info=INFO)
        self.now_s = 0.0
        if greeted:
            self.host.greet()
            assert [type(event) for event in self.to_device()] == [Hello]
            assert self.to_host() == [INFO]

    def to_device(self, line: Line = bytes) -> list[Event]:
        self.device.receive_data(line(self.host.data_to_send()), self.now_s)
        return drain(self.device)

    def to_host(self, line: Line = bytes) -> list[Event]:
        self.host.receive_data(line(self.device.data_to_send()), self.now_s)
        return drain(self.host)

    def wait(self, dt_s: float) -> None:
        self.now_s += dt_s
        self.host.tick(self.now_s)
        self.device.tick(self.now_s)

    def wait_for_host(self) -> None:
        self.now_s = deadline_s(self.host)
        self.host.tick(self.now_s)


def lost(data: bytes) -> bytes:
    return b""


def test_greeting_tells_the_host_who_is_there() -> None:
    joined = Joined()
    assert joined.host.commands_pending == 0
    assert joined.host.next_deadline() is None


def number_of(event: Command | Accepted | Unanswered) -> int:
    assert isinstance(event.message, SweepStart)
    return event.message.sweep


def test_a_command_is_delivered_accepted_and_done() -> None:
    joined = Joined()
    joined.host.send(Calibrate())
    command = only_command(joined.to_device())
    assert command.message == Calibrate()
    joined.device.accept(command)
    assert joined.to_host() == [Accepted(Calibrate())]
    joined.device.send(Calibration(9, 0))
    report = only_command(joined.to_host())
    joined.host.accept(report)
    assert joined.to_device() == [Accepted(Calibration(9, 0))]


def test_a_refusal_arrives_with_its_reason() -> None:
    joined = Joined()
    joined.host.send(SweepStart(1))
    command = only_command(joined.to_device())
    joined.device.refuse(command, NakCode.BUSY, "homing")
    assert joined.to_host() == [Refused(SweepStart(1), NakCode.BUSY, "homing")]


def test_commands_go_one_at_a_time_and_in_order() -> None:
    joined = Joined()
    sent: list[Sent] = [Reset(), SweepRequest(), SweepStart(1)]
    for message in sent:
        joined.host.send(message)
    delivered: list[Sent] = []
    for _ in sent:
        command = only_command(joined.to_device())
        delivered.append(command.message)
        joined.device.accept(command)
        joined.to_host()
    assert delivered == sent


def test_a_lost_command_is_repeated_and_a_lost_answer_does_not_deliver_it_twice() -> None:
    joined = Joined()
    joined.host.send(Reset())
    assert joined.to_device(lost) == []
    joined.wait_for_host()
    command = only_command(joined.to_device())
    joined.device.accept(command)
    assert joined.to_host(lost) == []
    joined.wait_for_host()
    assert joined.to_device() == []
    assert joined.to_host() == [Accepted(Reset())]


def test_waits_grow_within_bounds_until_the_command_is_given_up() -> None:
    joined = Joined()
    joined.host.send(Reset())
    waits = []
    for _ in range(TRIES):
        joined.to_device(lost)
        before_s = joined.now_s
        joined.wait_for_host()
        waits.append(joined.now_s - before_s)
    assert drain(joined.host) == [Unanswered(Reset())]
    assert joined.host.data_to_send() == b""
    assert waits == sorted(waits) and waits[-1] == pytest.approx(RETRY_MAX_S)
    assert all(RETRY_MIN_S <= wait <= RETRY_MAX_S + 1e-9 for wait in waits)


def test_patience_follows_the_answers() -> None:
    joined, repeated = Joined(), []
    for _ in range(20):
        joined.host.send(Reset())
        command = only_command(joined.to_device())
        joined.wait(0.1)  # longer than the first answer made it expect
        repeated.append(bool(joined.host.data_to_send()))
        joined.device.accept(command)
        joined.to_host()
    assert repeated[0] and not any(repeated[5:])
    joined.host.send(Reset())
    assert deadline_s(joined.host) - joined.now_s == pytest.approx(3 * 0.1, rel=0.1)


def test_a_repeated_greeting_is_answered_again_without_starting_over() -> None:
    joined = Joined(greeted=False)
    joined.host.greet()
    joined.to_device()
    joined.to_host(lost)
    joined.wait_for_host()
    assert joined.to_device() == []
    assert joined.to_host() == [INFO]


def test_a_new_session_starts_over_and_the_old_ones_frames_are_set_aside() -> None:
    joined = Joined()
    joined.host.send(Reset())
    stale = joined.host.data_to_send()
    joined.host = ScannerLink(Role.HOST, session=8, window_bytes=WINDOW)
    joined.host.greet()
    assert [type(event) for event in joined.to_device()] == [Hello]
    assert joined.to_host() == [INFO]
    joined.device.receive_data(stale, 0.0)
    assert drain(joined.device) == [Dropped(DropReason.SESSION, len(stale))]
    joined.host.send(Reset())
    assert [type(event) for event in joined.to_device()] == [Command]


def test_an_answer_from_before_a_new_session_is_not_sent() -> None:
    joined = Joined()
    joined.host.send(Reset())
    command = only_command(joined.to_device())
    joined.host = ScannerLink(Role.HOST, session=8, window_bytes=WINDOW)
    joined.host.greet()
    joined.to_device()
    joined.device.data_to_send()
    joined.device.accept(command)
    assert joined.device.data_to_send() == b""


def test_credit_stops_the_device_and_taking_columns_gives_more() -> None:
    joined = Joined()
    sent = 0
    while joined.device.has_credit(100):
        joined.device.send(column(sent))
        sent += 1
    assert joined.device.sent_bytes <= WINDOW
    with pytest.raises(LocalWireError, match="credit"):
        joined.device.send(column())
    assert len(joined.to_host()) == sent
    joined.to_device()
    assert joined.device.has_credit(100)


def test_credit_is_given_when_columns_are_taken_not_when_bytes_arrive() -> None:
    joined = Joined()
    while joined.device.has_credit(100):
        joined.device.send(column())
    joined.host.receive_data(joined.device.data_to_send(), 0.0)
    assert joined.host.data_to_send() == b""


def test_bytes_lost_on_the_way_do_not_eat_up_the_credit() -> None:
    joined = Joined()
    for _ in range(5):
        while joined.device.has_credit(100):
            joined.device.send(column())
        assert joined.to_host(lost) == []
        joined.device.send(Status(State.SWEEPING, 1, 0, joined.device.sent_bytes, True))
        joined.to_host()
        joined.to_device()
        assert joined.device.has_credit(WINDOW // 2)


def test_a_lost_credit_is_given_again_on_status() -> None:
    joined = Joined()
    while joined.device.has_credit(100):
        joined.device.send(column())
    joined.to_host()
    joined.to_device(lost)
    joined.device.send(Status(State.SWEEPING, 1, 0, joined.device.sent_bytes, True))
    joined.to_host()
    joined.to_device()
    assert joined.device.has_credit(100)


def test_an_older_credit_takes_nothing_back() -> None:
    joined = Joined()
    for total in (10_000, 5_000):
        frame = encode_frame(Credit.TYPE, encode_message(Credit(total)), seq=99, session=7)
        joined.device.receive_data(frame, 0.0)
        drain(joined.device)
    assert joined.device.has_credit(9_000)


def test_another_major_version_is_reported_and_told() -> None:
    joined = Joined(greeted=False)
    hello = encode_frame(Hello.TYPE, encode_message(Hello()), seq=0, session=7, flags=1, version=2)
    joined.device.receive_data(hello, 0.0)
    assert drain(joined.device) == [WrongVersion(2)]
    joined.host.greet()
    joined.host.data_to_send()
    (refused,) = joined.to_host()
    assert isinstance(refused, Refused)
    assert refused.code is NakCode.VERSION and "1.1" in refused.text
    joined.host.receive_data(encode_frame(2, b"", seq=0, session=7, version=9), 0.0)
    assert drain(joined.host) == [WrongVersion(9)]


@pytest.mark.parametrize(
    ("type_", "payload", "reason"),
    [
        (0x7F, b"", DropReason.UNKNOWN),  # a message of a newer minor version
        (SweepStart.TYPE, b"", DropReason.MALFORMED),
        (SweepHeader.TYPE, encode_message(SweepHeader(1, GridSpec(8, 8, 16, 16, 1, 1), 100, 9, 9)), DropReason.STRAY),
    ],
)
def test_what_the_device_cannot_use_is_set_aside_and_refused(type_: int, payload: bytes, reason: DropReason) -> None:
    joined = Joined()
    frame = encode_frame(type_, payload, seq=50, session=7, flags=Flag.ANSWER_WANTED)
    joined.device.receive_data(frame, 0.0)
    assert drain(joined.device) == [Dropped(reason, len(frame))]
    assert joined.device.data_to_send()[3] == 0x04
    silent = encode_frame(type_, payload, seq=51, session=7)
    joined.device.receive_data(silent, 0.0)
    drain(joined.device)
    assert joined.device.data_to_send() == b""


def test_each_end_sends_only_its_own_messages() -> None:
    joined = Joined()
    strays: list[tuple[ScannerLink, Sent | RangeColumn]] = [
        (joined.host, column()),
        (joined.host, Calibration(1, 0)),
        (joined.device, Reset()),
    ]
    for link, message in strays:
        with pytest.raises(LocalWireError, match="does not send"):
            link.send(message)
    with pytest.raises(LocalWireError, match="session"):
        ScannerLink(Role.HOST)
    with pytest.raises(LocalWireError, match="info"):
        ScannerLink(Role.DEVICE)
    with pytest.raises(LocalWireError, match="window"):
        ScannerLink(Role.HOST, session=1, window_bytes=100)
    with pytest.raises(LocalWireError, match="reads less"):
        joined.device.send(column(size=1024))


def test_a_frame_that_stops_in_the_middle_is_given_up_in_time() -> None:
    joined = Joined()
    whole = encode_frame(RangeColumn.TYPE, encode_message(column()), seq=3, session=7)
    joined.host.receive_data(whole[:50], joined.now_s)
    assert drain(joined.host) == []
    assert joined.host.next_deadline() is not None
    joined.wait_for_host()
    joined.host.receive_data(whole, joined.now_s)
    assert drain(joined.host) == [Dropped(DropReason.TRUNCATED, 50), column()]


@given(st.lists(st.sampled_from(["keep", "lose", "twice", "cut", "flip"]), min_size=1, max_size=12))
def test_commands_arrive_in_order_and_once_over_any_line(fates: list[str]) -> None:
    fate = itertools.chain(fates, itertools.repeat("keep"))

    def line(data: bytes) -> bytes:
        match next(fate):
            case "keep":
                return data
            case "lose":
                return b""
            case "twice":
                return data + data
            case "cut":
                return data[: len(data) // 2]
        return data[:10] + bytes(byte ^ 0x10 for byte in data[10:11]) + data[11:]

    joined, outcomes, delivered = Joined(), list[Event](), list[int]()
    for number in range(4):
        joined.host.send(SweepStart(number))
    while joined.host.commands_pending:
        for event in joined.to_device(line):
            if isinstance(event, Command):
                delivered.append(number_of(event))
                joined.device.accept(event)
        outcomes += [event for event in joined.to_host(line) if not isinstance(event, Dropped)]
        outcomes += drain(joined.host)
        joined.wait(0.05)
    assert delivered == sorted(set(delivered))
    accepted = [number_of(event) for event in outcomes if isinstance(event, Accepted)]
    given_up = [number_of(event) for event in outcomes if isinstance(event, Unanswered)]
    assert sorted(accepted + given_up) == [0, 1, 2, 3]
    assert set(accepted) <= set(delivered)


@given(st.binary(max_size=400), st.integers(0, 255))
def test_no_payload_upsets_either_end(payload: bytes, type_: int) -> None:
    joined = Joined()
    for link in (joined.host, joined.device):
        link.receive_data(encode_frame(type_, payload, seq=77, session=7, flags=1), 1.0)
        drain(link)
        link.tick(9.0)
