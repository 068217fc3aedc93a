"""Does a device speak the scanner link as PROTOCOL.md has it? Check after check, in words for a firmware author.

The device is swept with, twice or more: run this with an empty table.
"""

from __future__ import annotations

import secrets
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

from drivers.port import Port
from drivers.scanner import Scanner, ScannerConfig, SweepFinished, SweepInterrupted, SweepStarted
from protocol.errors import DriverError, FoveascanError
from protocol.framing import FRAME_OVERHEAD, Flag, Frame, FrameReader, encode_frame
from protocol.scanner_messages import (
    MAJOR,
    MINOR,
    Ack,
    Channel,
    DeviceInfo,
    Hello,
    Nak,
    NakCode,
    RangeColumn,
    Reset,
    Status,
    SweepHeader,
    SweepRequest,
    SweepStart,
    TextureColumn,
    decode_message,
    encode_message,
)

State = Literal["ok", "problem"]
_ANSWER_S = 1.0
_UNKNOWN_TYPE = 0x7E
_READ_BYTES = 65536


@dataclass(frozen=True, slots=True)
class Finding:
    """What one check found. cure : where PROTOCOL.md says how it should be, and what to change."""

    check: str
    state: State
    found: str
    cure: str = ""


class _Problem(Exception):
    """The device did not do as it should."""

    def __init__(self, found: str, cure: str) -> None:
        super().__init__(found)
        self.found, self.cure = found, cure


def examine_link(
    port: Port, config: ScannerConfig | None = None, clock: Callable[[], float] = time.monotonic
) -> Iterator[Finding]:
    """Every check on an open port; the first that leaves nothing to go on with is the last."""
    config = config or ScannerConfig()
    bare = _Bare(port, config, clock)
    checks: tuple[tuple[str, Callable[[], str], bool], ...] = (
        ("greeting", bare.check_greeting, True),
        ("a repeated greeting", bare.check_repeated_greeting, False),
        ("noise before a frame", bare.check_noise, False),
        ("an unknown command", bare.check_unknown_command, False),
        ("a malformed command", bare.check_malformed, False),
        ("a repeated command", bare.check_repeated_command, False),
        ("a start before it is configured", bare.check_early_start, False),
        ("frames of another session", bare.check_other_session, False),
        ("another major version", bare.check_other_major, False),
        ("channels of one turn", bare.check_channels, True),
        ("credit", bare.check_credit, False),
        ("a sweep", lambda: _check_sweeps(port, config, clock, bare.requests), False),
        ("columns sent again", lambda: _check_again(port, config, clock, bare.requests[0]), False),
        ("stopping", lambda: _check_stop(port, config, clock, bare.requests[0]), False),
    )
    for name, check, is_needed in checks:
        try:
            yield Finding(name, "ok", check())
        except _Problem as problem:
            yield Finding(name, "problem", problem.found, problem.cure)
            if is_needed:
                return
        except DriverError as error:
            yield Finding(name, "problem", str(error), "see PROTOCOL.md, States of a scanner")


class _Bare:
    """Frames by hand, without the link's own patience, so that every answer can be looked at."""

    def __init__(self, port: Port, config: ScannerConfig, clock: Callable[[], float]) -> None:
        self._port, self._config, self._clock = port, config, clock
        self._reader = FrameReader(config.payload_max)
        self._session = 0
        self._seq = 0
        self._hello_frame = b""
        self.requests: tuple[SweepRequest, ...] = ()  # that make up a whole sweep, as far as the device takes them

    def check_greeting(self) -> str:
        """HELLO is answered by HELLO_ACK that makes sense."""
        info = self._greet(self._config.window_bytes)
        if info.major != MAJOR:
            raise _Problem(f"it speaks {info.major}.{info.minor}, this is {MAJOR}.{MINOR}", "Versions")
        if not info.serial_number:
            raise _Problem("HELLO_ACK has no serial number", "a node finds a scanner again by its serial number")
        if info.retention_columns == 0:
            raise _Problem("it holds no columns", "without any, every byte lost on the line costs the sweep")
        said = f"{info.serial_number} {info.model}, link {info.major}.{info.minor}"
        return f"{said}, {info.counts_per_turn} counts a turn"

    def check_repeated_greeting(self) -> str:
        """The same HELLO again is answered again."""
        self._port.write(self._hello_frame)
        self._answer(DeviceInfo.TYPE, "a repeated HELLO", "Sessions: answer it, change nothing")
        return "answered again"

    def check_noise(self) -> str:
        """A frame behind noise, and behind a truncated frame, is found."""
        for what, spoil in (("noise", bytes(range(60))), ("half a frame", self._hello_frame[:14])):
            self._port.write(spoil + self._frame(Reset.TYPE, b"", Flag.ANSWER_WANTED))
            self._acked(f"a command behind {what}", "Reading: go on at the next magic behind this magic")
        return "found behind noise and behind half a frame"

    def check_unknown_command(self) -> str:
        """A command of a type it cannot know is refused with code 2."""
        self._refused(_UNKNOWN_TYPE, b"", NakCode.UNKNOWN)
        return "refused"

    def check_malformed(self) -> str:
        """A command that is too short is refused with code 3."""
        self._refused(SweepRequest.TYPE, b"\x03", NakCode.MALFORMED)
        return "refused"

    def check_repeated_command(self) -> str:
        """A command under the seq answered last gets the same answer."""
        frame = self._frame(Reset.TYPE, b"", Flag.ANSWER_WANTED)
        for _ in range(2):
            self._port.write(frame)
            self._acked("a repeated command", "Commands and retries: answer again, without doing it again")
        return "answered again"

    def check_early_start(self) -> str:
        """SWEEP_START before CONFIG is refused with code 6."""
        self._refused(SweepStart.TYPE, encode_message(SweepStart(1)), NakCode.NOT_NOW)
        return "refused"

    def check_other_session(self) -> str:
        """A command of another session is not answered."""
        other = self._session % 65535 + 1
        self._port.write(encode_frame(Reset.TYPE, b"", seq=self._seq, session=other, flags=Flag.ANSWER_WANTED))
        if self._next(lambda frame: frame.type in (Ack.TYPE, Nak.TYPE), 0.3) is not None:
            raise _Problem("it answers a session that nobody opened", "Sessions: set such frames aside")
        return "set aside"

    def check_other_major(self) -> str:
        """A HELLO of another major version is refused in its own version."""
        payload = encode_message(Hello(MAJOR + 1, 0))
        session = self._session % 65535 + 1
        self._port.write(
            encode_frame(Hello.TYPE, payload, seq=0, session=session, flags=Flag.ANSWER_WANTED, version=MAJOR + 1)
        )
        frame = self._next(lambda frame: frame.type == Nak.TYPE, _ANSWER_S)
        if frame is None:
            raise _Problem("no answer to a HELLO of another major version", "Versions: NAK code 1, in your own version")
        return "refused"

    def check_channels(self) -> str:
        """One turn takes range and texture, or each is taken alone."""
        apart = tuple(SweepRequest(channel) for channel in (Channel.RANGE, Channel.TEXTURE))
        takes_both = self._takes(SweepRequest())
        takes_apart = [self._takes(request) for request in apart]
        if not takes_both and not all(takes_apart):
            cure = "CONFIG: accept channels 3, or both 1 and 2; NAK code 5 refuses what it cannot do"
            raise _Problem("no turns that it takes give range and texture", cure)
        self.requests = (SweepRequest(),) * takes_both + apart * all(takes_apart)
        return ", ".join(["range and texture at once"] * takes_both + ["each in a turn of its own"] * all(takes_apart))

    def _takes(self, request: SweepRequest) -> bool:
        """Whether it accepts a configuration; it may refuse it with code 5 only."""
        self._port.write(self._frame(SweepRequest.TYPE, encode_message(request), Flag.ANSWER_WANTED))
        message = self._decoded(self._answered("CONFIG"))
        if isinstance(message, Nak) and message.code is not NakCode.UNSUPPORTED:
            raise _Problem(f"CONFIG was refused: {message.code.name.lower()}: {message.text}", "Messages: NAK codes")
        return isinstance(message, Ack)

    def _answered(self, to: str) -> Frame:
        frame = self._next(lambda frame: frame.type in (Ack.TYPE, Nak.TYPE), _ANSWER_S)
        if frame is None:
            raise _Problem(f"no answer to {to} within {_ANSWER_S:g} s", "Commands and retries")
        return frame

    def check_credit(self) -> str:
        """With a window of a few frames it stops there, and says so."""
        window = 4 * (FRAME_OVERHEAD + self._config.payload_max)
        self._greet(window)
        for command in (Reset(), self.requests[0], SweepStart(1)):
            self._port.write(self._frame(command.TYPE, encode_message(command), Flag.ANSWER_WANTED))
            self._acked(type(command).__name__, "States of a scanner")
        header = self._next(lambda frame: frame.type == SweepHeader.TYPE, _ANSWER_S)
        if header is None:
            raise _Problem("no SWEEP_HEADER after SWEEP_START", "States of a scanner: sweeping begins with it")
        self._decoded(header)
        self._acknowledge(header)
        sent, starved = 0, False
        until_s = self._clock() + 2 * _ANSWER_S
        while not starved and (frame := self._next(lambda _: True, until_s - self._clock())) is not None:
            message = self._decoded(frame)
            sent += frame.size_bytes if isinstance(message, RangeColumn | TextureColumn) else 0
            starved = isinstance(message, Status) and message.out_of_credit
        self._port.write(self._frame(Reset.TYPE, b"", Flag.ANSWER_WANTED))
        if sent > window:
            raise _Problem(f"{sent} bytes of columns with a credit of {window}", "Credit: the table stops instead")
        if not starved:
            raise _Problem("it never said that it is out of credit", "Credit: STATUS every 0.1 s then")
        return f"stopped after {sent} of {window} bytes and said so"

    def _acknowledge(self, header: Frame) -> None:
        """Answer SWEEP_HEADER, before which no column may come."""
        if self._next(lambda frame: frame.type in (RangeColumn.TYPE, TextureColumn.TYPE), 0.2) is not None:
            raise _Problem("columns came before SWEEP_HEADER was acknowledged", "A sweep, as it looks on the line")
        self._port.write(self._frame(Ack.TYPE, encode_message(Ack(header.seq))))

    # -- frames --------------------------------------------------------------------------------------------------

    def _greet(self, window_bytes: int) -> DeviceInfo:
        self._session, self._seq = 1 + secrets.randbelow(65535), 0
        hello = Hello(payload_max=self._config.payload_max, window_bytes=window_bytes)
        self._hello_frame = self._frame(Hello.TYPE, encode_message(hello), Flag.ANSWER_WANTED)
        for _ in range(3):
            self._port.write(self._hello_frame)
            frame = self._next(self._answers_greeting, _ANSWER_S)
            if frame is not None:
                return self._as_info(frame)
        heard = "frames, but no HELLO_ACK" if self._reader.waits_inside_frame else "nothing that can be read"
        raise _Problem(f"no answer to HELLO: heard {heard}", "Frame: magic, CRC-16, CRC-32; is the baud right?")

    def _answers_greeting(self, frame: Frame) -> bool:
        return frame.session == self._session and frame.type in (DeviceInfo.TYPE, Nak.TYPE)

    def _as_info(self, frame: Frame) -> DeviceInfo:
        message = self._decoded(frame)
        if isinstance(message, Nak):
            raise _Problem(f"HELLO was refused: {message.code.name.lower()}: {message.text}", "Versions")
        assert isinstance(message, DeviceInfo)
        return message

    def _frame(self, type_: int, payload: bytes, flags: Flag = Flag.NONE) -> bytes:
        frame = encode_frame(type_, payload, seq=self._seq, session=self._session, flags=flags)
        self._seq += 1
        return frame

    def _next(self, wanted: Callable[[Frame], bool], within_s: float) -> Frame | None:
        """The next frame of this session (or of another version) that is wanted."""
        until_s = self._clock() + within_s
        while True:
            found = self._reader.next_event()
            if isinstance(found, Frame) and wanted(found):
                return found
            if found is None:
                left_s = until_s - self._clock()
                if left_s <= 0:
                    return None
                self._reader.receive_data(self._port.read(_READ_BYTES, left_s))

    def _answer(self, type_: int, to: str, cure: str) -> Frame:
        frame = self._next(lambda frame: frame.type == type_, _ANSWER_S)
        if frame is None:
            raise _Problem(f"no answer to {to} within {_ANSWER_S:g} s", cure)
        return frame

    def _acked(self, to: str, cure: str) -> None:
        frame = self._next(lambda frame: frame.type in (Ack.TYPE, Nak.TYPE), _ANSWER_S)
        message = self._decoded(frame) if frame is not None else None
        if not isinstance(message, Ack) or message.acked_seq != self._seq - 1:
            raise _Problem(f"{to} was not acknowledged but answered by {message}", cure)

    def _refused(self, type_: int, payload: bytes, code: NakCode) -> None:
        self._port.write(self._frame(type_, payload, Flag.ANSWER_WANTED))
        frame = self._next(lambda frame: frame.type in (Ack.TYPE, Nak.TYPE), _ANSWER_S)
        message = self._decoded(frame) if frame is not None else None
        if not isinstance(message, Nak) or message.code is not code:
            raise _Problem(f"answered by {message}, not by NAK code {code}", "Messages: NAK codes")

    def _decoded(self, frame: Frame) -> object:
        try:
            return decode_message(frame.type, frame.payload)
        except (KeyError, FoveascanError) as error:
            raise _Problem(f"message type {frame.type:#04x} does not follow its table: {error}", "Messages") from error


def _check_sweeps(
    port: Port, config: ScannerConfig, clock: Callable[[], float], requests: tuple[SweepRequest, ...]
) -> str:
    """A whole sweep with the node's own driver, for every kind of turn that the device takes."""
    scanner = Scanner(port, config, clock)
    scanner.hello()
    return "; ".join(_check_sweep(scanner, request) for request in requests)


def _check_sweep(scanner: Scanner, request: SweepRequest) -> str:
    for event in scanner.sweep(request):
        if isinstance(event, SweepStarted) and event.header.channels is not request.channels:
            raise _Problem("its SWEEP_HEADER has other channels than CONFIG", "SWEEP_HEADER: channels as in CONFIG")
        if isinstance(event, SweepInterrupted):
            raise _Problem(f"interrupted: {event.reason}", "Missing columns; SWEEP_END's pieces and digest")
        if isinstance(event, SweepFinished):
            report = event.report
    rate = f"{report.received} pieces in {report.elapsed_s:.2f} s"
    if report.duplicates or report.strays:
        return f"{rate}, {report.duplicates} of them twice, {report.strays} that belong nowhere"
    return f"{rate}, digest agrees"


def _check_again(port: Port, config: ScannerConfig, clock: Callable[[], float], request: SweepRequest) -> str:
    """The first column, asked for after the sweep, comes byte for byte as before."""
    scanner = Scanner(port, config, clock)
    scanner.hello()
    before: dict[int, bytes] = {}
    held, header = [], None
    for event in scanner.sweep(request):
        if isinstance(event, SweepStarted):
            header = event.header
        elif isinstance(event, RangeColumn | TextureColumn):
            is_first = event.column == 0 and event.CHANNEL is Channel.RANGE
            if is_first:
                before[event.row0] = event.to_bytes()
            else:
                held.append(event)
    assert header is not None
    for event in scanner.resume(header, held):
        if isinstance(event, RangeColumn) and event.to_bytes() != before[event.row0]:
            raise _Problem("a column sent again is another one", "RANGE_COLUMN: the same byte for byte")
        if isinstance(event, SweepInterrupted):
            raise _Problem(f"asked for again: {event.reason}", "Missing columns: hold them until RESET")
    return f"{len(before)} pieces, byte for byte"


def _check_stop(port: Port, config: ScannerConfig, clock: Callable[[], float], request: SweepRequest) -> str:
    """A sweep that is stopped ends, and another one can begin."""
    scanner, stop = Scanner(port, config, clock), threading.Event()
    scanner.hello()
    last = None
    for event in scanner.sweep(request, stop):
        last = event
        stop.set()
    if not isinstance(last, SweepInterrupted | SweepFinished):
        raise _Problem("it goes on", "States of a scanner: SWEEP_STOP, then SWEEP_END (stopped)")
    return "the sweep ended"
