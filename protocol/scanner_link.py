"""The conversation between a node and a scanner, without I/O and without a clock: one class for both ends.

The rules live here:

- Commands are numbered by their frame and one is in flight per direction. It is answered by ACK or NAK (HELLO by
  HELLO_ACK), repeated unchanged when no answer comes, five times in all, and a repeated one is answered again but not
  delivered again. So commands arrive in order and once.
- Columns are neither acknowledged nor repeated by the link: they are named, and whoever misses one asks for it.
- Column frames are sent only against credit, counted in bytes since the session began. STATUS says how much was
  really sent, so bytes lost on the way never eat up the credit.
- A HELLO with a new session number begins a session: numbering, credit and unanswered commands start afresh at both
  ends, and frames of other sessions are set aside.
- Ends of one major version understand each other; the newer minor one does without what the other does not know.

Bytes go in by `receive_data`, events come out of `next_event`, messages go in by `send`, `accept` and `refuse`, bytes
come out of `data_to_send`. The time is told by `receive_data` and `tick`; `next_deadline` says when to tick at latest.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from protocol.errors import LocalWireError, RemoteWireError
from protocol.framing import (
    FRAME_OVERHEAD,
    SERIAL_PAYLOAD_MAX,
    Dropped,
    DropReason,
    Flag,
    Frame,
    FrameReader,
    encode_frame,
)
from protocol.scanner_events import (
    Accepted,
    Command,
    DeviceCommand,
    Event,
    HostCommand,
    Refused,
    Role,
    Sent,
    Unanswered,
    WrongVersion,
)
from protocol.scanner_messages import (
    COLUMN_OVERHEAD,
    MAJOR,
    MINOR,
    Ack,
    Calibrate,
    Calibration,
    Column,
    ColumnsGone,
    Credit,
    DeviceInfo,
    Fault,
    Hello,
    Message,
    Nak,
    NakCode,
    RangeColumn,
    RequestColumns,
    Reset,
    Status,
    SweepEnd,
    SweepHeader,
    SweepRequest,
    SweepStart,
    SweepStop,
    TextureColumn,
    decode_message,
    encode_message,
    is_known,
)

__all__ = [
    "Accepted", "Command", "DeviceCommand", "Event", "HostCommand", "Refused", "Role", "ScannerLink", "Sent",
    "Unanswered", "WrongVersion",
]  # fmt: skip

TRIES = 5
RETRY_MIN_S = 0.05
RETRY_MAX_S = 3.2
_RETRY_FIRST_S = 0.2  # before an answer was ever timed
_RETRY_GROWTH = 4.0  # five tries reach from the shortest wait to the longest
_PARTIAL_MAX_S = 0.2  # a frame that pauses longer in the middle lost its rest
_SEQ_MODULO = 2**32

_HOST_COMMANDS = (Hello, Reset, SweepRequest, Calibrate, SweepStart, SweepStop, RequestColumns)
_DEVICE_COMMANDS = (Calibration, SweepHeader, SweepEnd, ColumnsGone, Fault)
_COLUMNS = (RangeColumn, TextureColumn)


@dataclass(slots=True)
class _Flight:
    """A command on its way: when it was first sent, and when its patience ends."""

    message: Sent
    seq: int
    sent_s: float
    wait_s: float
    deadline_s: float
    tries: int = 1


class ScannerLink:
    """One end of the link.

    session : the host's choice, 1..65535, another one at every attempt to connect; a device takes it from HELLO.
    info : what a device answers to HELLO.    payload_max : longest payload this end reads. [bytes]
    window_bytes : how many bytes of columns a host lets the device send ahead of their being taken.
    """

    def __init__(
        self,
        role: Role,
        *,
        session: int = 0,
        info: DeviceInfo | None = None,
        payload_max: int = SERIAL_PAYLOAD_MAX,
        window_bytes: int = 65536,
    ) -> None:
        if role is Role.HOST and not 1 <= session <= 0xFFFF:
            raise LocalWireError(f"session must be 1..65535, got {session}")
        if (role is Role.DEVICE) != (info is not None):
            raise LocalWireError("a device, and only a device, has an info")
        if window_bytes < payload_max + FRAME_OVERHEAD:
            raise LocalWireError(f"a window of {window_bytes} bytes has no room for one frame")
        self.role = role
        self.peer_payload_max = SERIAL_PAYLOAD_MAX
        self.frames_heard = 0
        self._info = info
        self._payload_max = payload_max
        self._window_bytes = window_bytes
        self._reader = FrameReader(payload_max)
        self._events: deque[Event] = deque()
        self._out: list[bytes] = []
        self._now_s = 0.0
        self._data_s = 0.0
        self._answer_s: float | None = None
        self._begin_session(session, window_bytes)

    # -- bytes and time ------------------------------------------------------------------------------------------

    def receive_data(self, data: bytes, now_s: float) -> None:
        """Take bytes off the line; drain next_event before the next call."""
        self._now_s = self._data_s = now_s
        self._reader.receive_data(data)

    def next_event(self) -> Event | None:
        """What happened next, or None until bytes or time bring more."""
        while not self._events:
            found = self._reader.next_event()
            if found is None:
                return None
            event = self._take_frame(found) if isinstance(found, Frame) else found
            if event is not None:
                return event
        return self._events.popleft()

    def data_to_send(self) -> bytes:
        """Everything to be written to the line now; hands it over once."""
        data = b"".join(self._out)
        self._out.clear()
        return data

    def tick(self, now_s: float) -> None:
        """Tell the time: repeats or gives up the command in flight, and frames that stopped in the middle."""
        self._now_s = now_s
        if self._reader.waits_inside_frame and now_s >= self._data_s + _PARTIAL_MAX_S:
            self._reader.abandon_partial()
        flight = self._flight
        if flight is not None and now_s >= flight.deadline_s:
            self._repeat(flight)

    def next_deadline(self) -> float | None:
        """When `tick` has something to do if nothing arrives before, or None. [s, on the caller's clock]"""
        deadlines = [self._flight.deadline_s] if self._flight else []
        if self._reader.waits_inside_frame:
            deadlines.append(self._data_s + _PARTIAL_MAX_S)
        return min(deadlines, default=None)

    # -- messages to the other end -------------------------------------------------------------------------------

    def send(self, message: Sent | Status | Column) -> None:
        """Send a message, or queue a command behind those unanswered.

        Raises LocalWireError when it is not this end's to send, does not fit its fields, or a column has no credit.
        """
        if isinstance(message, _HOST_COMMANDS if self.role is Role.HOST else _DEVICE_COMMANDS):
            encode_message(message)  # refuses here, not when its turn comes
            self._waiting.append(message)
            self._launch()
        elif self.role is Role.DEVICE and isinstance(message, _COLUMNS):
            self._send_column(message)
        elif self.role is Role.DEVICE and isinstance(message, Status):
            self._write(message)
        else:
            raise LocalWireError(f"a {self.role.value} does not send {type(message).__name__}")

    def greet(self) -> None:
        """Host: send HELLO, which opens the session."""
        self.send(Hello(payload_max=self._payload_max, window_bytes=self._window_bytes))

    def accept(self, command: Command) -> None:
        """Answer ACK to the command delivered last."""
        self._answer_command(command, Ack(command.seq))

    def refuse(self, command: Command, code: NakCode, text: str) -> None:
        """Answer NAK to the command delivered last."""
        self._answer_command(command, Nak(command.seq, code, text))

    @property
    def commands_pending(self) -> int:
        """Commands of ours that are not answered yet."""
        return len(self._waiting) + (self._flight is not None)

    @property
    def sent_bytes(self) -> int:
        """Device: column frames sent in this session. [bytes]"""
        return self._column_bytes

    def has_credit(self, data_bytes: int) -> bool:
        """Device: whether a column with that many bytes of samples may be sent now."""
        return self._column_bytes + FRAME_OVERHEAD + COLUMN_OVERHEAD + data_bytes <= self._credit_bytes

    # -- sessions ------------------------------------------------------------------------------------------------

    def _begin_session(self, session: int, window_bytes: int) -> None:
        self._session = session
        self._seq = 0
        self._waiting: deque[Sent] = deque()
        self._flight: _Flight | None = None
        self._heard_seq: int | None = None
        self._answer: Ack | Nak | None = None
        self._column_bytes = 0  # column frames sent (device), or known to be sent (host)
        self._credit_bytes = window_bytes

    def _greeted(self, frame: Frame, hello: Hello) -> Event | None:
        """Device: HELLO opens a session; a repeated one is answered again."""
        assert self._info is not None
        is_new = frame.session != self._session
        if is_new:
            self._out.clear()
            self._begin_session(frame.session, hello.window_bytes)
            self.peer_payload_max = min(hello.payload_max, self._info.payload_max)
        self._write(self._info)
        return hello if is_new else None

    def _met(self, info: DeviceInfo) -> Event | None:
        """Host: the answer to HELLO."""
        if self._flight is None or not isinstance(self._flight.message, Hello):
            return None
        self.peer_payload_max = min(info.payload_max, self._payload_max)
        self._land(self._flight)
        return info

    # -- frames from the other end -------------------------------------------------------------------------------

    def _take_frame(self, frame: Frame) -> Event | None:
        if frame.version != MAJOR:
            return self._meet_stranger(frame)
        if frame.session != self._session and not (self.role is Role.DEVICE and frame.type == Hello.TYPE):
            return Dropped(DropReason.SESSION, frame.size_bytes)
        if not is_known(frame.type):
            return self._reject(frame, DropReason.UNKNOWN, NakCode.UNKNOWN, f"no message type {frame.type:#04x}")
        try:
            message = decode_message(frame.type, frame.payload)
        except RemoteWireError as error:
            return self._reject(frame, DropReason.MALFORMED, NakCode.MALFORMED, str(error)[:150])
        self.frames_heard += 1
        if isinstance(message, _COLUMNS) and self.role is Role.HOST:  # thousands a second
            self._count_column(FRAME_OVERHEAD + len(frame.payload))
            return message
        return self._take_message(frame, message)

    def _take_message(self, frame: Frame, message: Message) -> Event | None:
        if isinstance(message, Ack):
            return self._answered(message.acked_seq, None)
        if isinstance(message, Nak):
            return self._answered(message.refused_seq, message)
        if self.role is Role.HOST:
            return self._take_from_device(frame, message)
        return self._take_from_host(frame, message)

    def _take_from_device(self, frame: Frame, message: Message) -> Event | None:
        if isinstance(message, Status):
            self._correct_count(message)
            return message
        if isinstance(message, DeviceInfo):
            return self._met(message)
        if isinstance(message, _DEVICE_COMMANDS):
            return self._deliver(frame, message)
        return self._reject_stray(frame)

    def _take_from_host(self, frame: Frame, message: Message) -> Event | None:
        if isinstance(message, Credit):
            self._credit_bytes = max(self._credit_bytes, message.total_bytes)
            return None
        if isinstance(message, Hello):
            return self._greeted(frame, message)
        if isinstance(message, _HOST_COMMANDS):
            return self._deliver(frame, message)
        return self._reject_stray(frame)

    def _meet_stranger(self, frame: Frame) -> Event:
        """A frame of another major version: tell a greeting host so in words it can read, and report it."""
        if self.role is Role.DEVICE and frame.type == Hello.TYPE:
            refusal = Nak(frame.seq, NakCode.VERSION, f"this scanner speaks {MAJOR}.{MINOR}")
            self._out.append(
                encode_frame(Nak.TYPE, encode_message(refusal), seq=0, session=frame.session, version=MAJOR)
            )
        return WrongVersion(frame.version)

    def _reject_stray(self, frame: Frame) -> Dropped:
        return self._reject(frame, DropReason.STRAY, NakCode.UNKNOWN, f"not for a {self.role.value}")

    def _reject(self, frame: Frame, reason: DropReason, code: NakCode, text: str) -> Dropped:
        """Set a frame aside, and say so when it wanted an answer."""
        if frame.flags & Flag.ANSWER_WANTED:
            self._write(Nak(frame.seq, code, text))
        return Dropped(reason, frame.size_bytes)

    # -- commands ------------------------------------------------------------------------------------------------

    def _deliver(self, frame: Frame, message: Sent) -> Event | None:
        """Hand a command over once; answer a repeated one as before."""
        behind = 0 if self._heard_seq is None else (self._heard_seq - frame.seq) % _SEQ_MODULO
        if self._heard_seq is not None and behind < _SEQ_MODULO // 2:
            if behind == 0 and self._answer is not None:
                self._write(self._answer)
            return None
        self._heard_seq, self._answer = frame.seq, None
        return Command(frame.seq, message)

    def _answer_command(self, command: Command, answer: Ack | Nak) -> None:
        if command.seq != self._heard_seq:
            return  # a new session began meanwhile: nobody waits for this answer
        self._answer = answer
        self._write(answer)

    def _launch(self) -> None:
        """Send the next waiting command when none is in flight."""
        if self._flight is None and self._waiting:
            message = self._waiting.popleft()
            wait_s = self._patience_s()
            self._flight = _Flight(message, self._seq, self._now_s, wait_s, self._now_s + wait_s)
            self._write(message, Flag.ANSWER_WANTED)

    def _repeat(self, flight: _Flight) -> None:
        if flight.tries == TRIES:
            self._events.append(Unanswered(flight.message))
            self._clear_flight()
            return
        flight.tries += 1
        flight.wait_s = min(flight.wait_s * _RETRY_GROWTH, RETRY_MAX_S)
        flight.deadline_s = self._now_s + flight.wait_s
        self._append(flight.message, flight.seq, Flag.ANSWER_WANTED | Flag.RESENT)

    def _answered(self, seq: int, nak: Nak | None) -> Event | None:
        flight = self._flight
        if flight is None or flight.seq != seq:
            return None  # the answer to a repetition of something long answered
        self._land(flight)
        if nak is not None:
            return Refused(flight.message, nak.code, nak.text)
        return Accepted(flight.message)

    def _land(self, flight: _Flight) -> None:
        """The command in flight is answered: learn from its time, and send the next.

        Which of several repetitions was answered nobody can tell; their last wait was long enough, so it counts.
        """
        took_s = self._now_s - flight.sent_s if flight.tries == 1 else flight.wait_s
        self._answer_s = took_s if self._answer_s is None else 0.75 * self._answer_s + 0.25 * took_s
        self._clear_flight()

    def _clear_flight(self) -> None:
        self._flight = None
        self._launch()

    def _patience_s(self) -> float:
        """How long to wait for the first answer. [s]"""
        if self._answer_s is None:
            return _RETRY_FIRST_S
        return min(max(3 * self._answer_s, RETRY_MIN_S), RETRY_MAX_S)

    # -- credit --------------------------------------------------------------------------------------------------

    def _send_column(self, column: Column) -> None:
        if not self.has_credit(len(column.data)):
            raise LocalWireError("no credit for this column")
        self._column_bytes += self._write(column)

    def _count_column(self, size_bytes: int) -> None:
        """Host: a column was taken; give new credit when half the window is used."""
        self._column_bytes += size_bytes
        if self._credit_bytes - self._column_bytes <= self._window_bytes // 2:
            self._give_credit()

    def _correct_count(self, status: Status) -> None:
        """Host: what was sent before this STATUS has arrived or is lost, so it no longer burdens the credit."""
        is_short = status.out_of_credit or status.sent_bytes > self._column_bytes
        self._column_bytes = max(self._column_bytes, status.sent_bytes)
        if is_short:
            self._give_credit()

    def _give_credit(self) -> None:
        self._credit_bytes = self._column_bytes + self._window_bytes
        self._write(Credit(self._credit_bytes))

    # -- writing -------------------------------------------------------------------------------------------------

    def _write(self, message: Message, flags: Flag = Flag.NONE) -> int:
        """Queue a message under the next number; returns its size on the line. [bytes]"""
        size_bytes = self._append(message, self._seq, flags)
        self._seq = (self._seq + 1) % _SEQ_MODULO
        return size_bytes

    def _append(self, message: Message, seq: int, flags: Flag) -> int:
        payload = encode_message(message)
        if len(payload) > self.peer_payload_max:
            raise LocalWireError(f"{type(message).__name__} of {len(payload)} bytes, the other end reads less")
        frame = encode_frame(message.TYPE, payload, seq=seq, session=self._session, flags=flags, version=MAJOR)
        self._out.append(frame)
        return len(frame)
