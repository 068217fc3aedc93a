"""A software scanner: a turntable that speaks the device's end of the scanner link. No I/O and no clock of its own.

It sends columns live, in the order the table turns, or buffered, from its memory and coarse to fine, and holds the
newest `retention_columns` of them to send again. When the node gives no credit, a few columns wait in the outbox and
then the table stops: nothing is dropped.
"""

from __future__ import annotations

from protocol.framing import SERIAL_PAYLOAD_MAX
from protocol.scanner_link import Accepted, Command, Role, ScannerLink, Unanswered
from protocol.scanner_messages import (
    COLUMN_OVERHEAD,
    RUNS_MAX,
    Calibrate,
    Calibration,
    Channel,
    Column,
    ColumnsGone,
    DeviceInfo,
    Hello,
    NakCode,
    Order,
    RangeColumn,
    RequestColumns,
    Reset,
    State,
    Status,
    SweepHeader,
    SweepRequest,
    SweepStart,
    SweepStop,
    TextureColumn,
)
from simulators.sweep import Sweep
from simulators.turntable import Turntable

_STATUS_S = 0.5
_STATUS_STARVED_S = 0.1
_STEP_S = 0.005  # while the table moves and nothing can be sent
_IDLE_S = 0.5
_IN_A_TURN = {Channel.RANGE: "range alone", Channel.TEXTURE: "texture alone", Channel.BOTH: "both"}
ANY_CHANNELS = (Channel.RANGE, Channel.TEXTURE, Channel.BOTH)
APART = (Channel.RANGE, Channel.TEXTURE)
TOGETHER = (Channel.BOTH,)


class SimulatedScanner:
    """The device at the end of a line; a carrier moves its bytes and tells it the time.

    boot_id : another one stands for a device that was switched off and on.
    channels : what it takes in one turn; a scanner of one camera at a time takes range and texture apart.
    """

    portion_bytes: int | None = None

    def __init__(
        self,
        table: Turntable,
        *,
        serial_number: str = "SIM-0001",
        boot_id: int = 1,
        calibration: int = 1,
        retention_columns: int = 65535,
        payload_max: int = SERIAL_PAYLOAD_MAX,
        order: Order = Order.LIVE,
        channels: tuple[Channel, ...] = ANY_CHANNELS,
    ) -> None:
        counts = table.counts_per_turn
        self.info = DeviceInfo(serial_number, boot_id, counts, retention_columns, "simulator", order, payload_max)
        self.state = State.IDLE
        self._table = table
        self._calibration = calibration
        self._channels = channels
        self._link = ScannerLink(Role.DEVICE, info=self.info, payload_max=payload_max)
        self._now_s: float | None = None
        self._status_s = 0.0
        self._request: SweepRequest | None = None
        self._sweep: Sweep | None = None

    def receive_data(self, data: bytes, now_s: float) -> None:
        """Take bytes off the line and do what they say."""
        self._link.receive_data(data, now_s)
        self._heed()

    def step(self, now_s: float) -> None:
        """Let the time become now_s."""
        dt_s = 0.0 if self._now_s is None else now_s - self._now_s
        self._now_s = now_s
        self._link.tick(now_s)
        self._heed()
        self._move(dt_s)
        self._report(now_s)

    def data_to_send(self, max_bytes: int) -> bytes:
        """Bytes for the line: answers first, then columns as far as credit and about `max_bytes` go."""
        parts = [self._link.data_to_send()]
        size = len(parts[0])
        while size < max_bytes and (piece := self._next_piece()) is not None:
            self._link.send(piece)
            parts.append(self._link.data_to_send())
            size += len(parts[-1])
        self._end_if_done()
        parts.append(self._link.data_to_send())
        return b"".join(parts)

    def wait_s(self, now_s: float) -> float:
        """How long a carrier may wait for bytes from the node before it steps again. [s]"""
        if self._sweep is not None and self._sweep.head is not None and not self._is_starved():
            return 0.0
        if self._table.is_moving or self._is_starved():
            return _STEP_S
        deadline_s = self._link.next_deadline()
        return _IDLE_S if deadline_s is None else min(max(deadline_s - now_s, 0.0), _IDLE_S)

    # -- commands ------------------------------------------------------------------------------------------------

    def _heed(self) -> None:
        while (event := self._link.next_event()) is not None:
            match event:
                case Command():
                    self._obey(event)
                case Hello():
                    self._announce()
                case Accepted(SweepHeader() as header):
                    self._begin(header)
                case Unanswered(SweepHeader()):
                    self._rest()

    def _obey(self, command: Command) -> None:
        refusal = self._do(command.message)
        if refusal is None:
            self._link.accept(command)
        else:
            self._link.refuse(command, *refusal)
        if refusal is None and isinstance(command.message, SweepStart):
            self._announce()

    def _do(self, message: object) -> tuple[NakCode, str] | None:
        """Carry out a command, or say why not."""
        match message:
            case Reset():
                self._rest()
            case _ if self.state is State.HOMING:
                return NakCode.BUSY, "homing"
            case RequestColumns():
                return self._look_up(message)
            case SweepStop(sweep):
                return self._stop(sweep)
            case _ if self.state is State.SWEEPING:
                return NakCode.BUSY, "sweeping"
            case Calibrate():
                self._table.home()
                self.state = State.HOMING
            case SweepRequest():
                return self._configure(message)
            case SweepStart(sweep):
                return self._prepare(sweep)
        return None

    def _rest(self) -> None:
        """Drop the sweep and everything about it."""
        self._table.halt()
        self.state, self._sweep, self._request = State.IDLE, None, None

    def _configure(self, request: SweepRequest) -> tuple[NakCode, str] | None:
        if request.channels not in self._channels:
            takes = ", ".join(_IN_A_TURN[channels] for channels in self._channels)
            return NakCode.UNSUPPORTED, f"one turn takes {takes}, not {_IN_A_TURN[request.channels]}"
        spec = self._table.specimen.grid.spec
        sizes = {
            "width": (request.width, spec.width),
            "height": (request.height, spec.height),
            "texture width": (request.texture_width, spec.texture_width),
            "texture height": (request.texture_height, spec.texture_height),
        }
        for name, (wanted, native) in sizes.items():
            if wanted not in (0, native):
                return NakCode.UNSUPPORTED, f"{name} is {native}, not {wanted}"
        self._request = request
        return None

    def _prepare(self, sweep: int) -> tuple[NakCode, str] | None:
        request = self._request
        if request is None:
            return NakCode.NOT_NOW, "no configuration yet"
        try:
            self._table.begin(request.channels, request.passes, request.overlap, request.stride)
        except ValueError as error:
            return NakCode.UNSUPPORTED, str(error)
        room = self._link.peer_payload_max - COLUMN_OVERHEAD
        header = SweepHeader(
            sweep,
            self._table.specimen.grid.spec,
            self._table.counts_per_turn,
            range_rows=room // RangeColumn.SAMPLE_BYTES,
            texture_rows=room // TextureColumn.SAMPLE_BYTES,
            channels=request.channels,
            passes=request.passes,
            encoder_start=self._table.home_encoder,
            calibration=self._calibration,
            overlap=request.overlap,
        )
        self._sweep = Sweep(header, self._table, self.info.retention_columns, self.info.order)
        self.state = State.SWEEPING
        return None

    def _announce(self) -> None:
        """Say the header of a sweep that waits to begin: it turns only when the node knows what is coming."""
        if self._sweep is not None and not self._sweep.is_announced:
            self._link.send(self._sweep.header)

    def _begin(self, header: SweepHeader) -> None:
        if self._sweep is not None and self._sweep.header is header:
            self._sweep.is_announced = True

    def _stop(self, sweep: int) -> tuple[NakCode, str] | None:
        if self._sweep is None or sweep != self._sweep.header.sweep:
            return NakCode.NOT_NOW, f"no sweep {sweep}"
        if self.state is State.SWEEPING:
            self._table.halt()
            self._sweep.cut_short()
        return None

    def _look_up(self, request: RequestColumns) -> tuple[NakCode, str] | None:
        if self._sweep is None or request.sweep != self._sweep.header.sweep:
            return NakCode.NOT_NOW, f"no sweep {request.sweep}"
        gone = self._sweep.send_again(request.runs)
        for first in range(0, len(gone), RUNS_MAX):
            self._link.send(ColumnsGone(request.sweep, tuple(gone[first : first + RUNS_MAX])))
        return None

    # -- what happens by itself ----------------------------------------------------------------------------------

    def _move(self, dt_s: float) -> None:
        """Turn the table, if something lets it."""
        if self.state is State.HOMING:
            self._table.step(dt_s, 0)
            if not self._table.is_moving:
                self.state = State.IDLE
                self._link.send(Calibration(self._calibration, self._table.home_encoder))
        elif self._sweep is not None and self._sweep.is_announced:
            self._sweep.expose(dt_s)

    def _report(self, now_s: float) -> None:
        """STATUS, as long as somebody may be waiting for it."""
        is_starved = self._is_starved()
        due_s = self._status_s + (_STATUS_STARVED_S if is_starved else _STATUS_S)
        is_awaited = is_starved or self._link.commands_pending > 0 or self.state in (State.HOMING, State.SWEEPING)
        if now_s >= due_s and is_awaited:
            self._status_s = now_s
            sweep = self._sweep.header.sweep if self._sweep is not None else 0
            self._link.send(Status(self.state, sweep, self._table.encoder, self._link.sent_bytes, is_starved))

    def _is_starved(self) -> bool:
        piece = self._sweep.head if self._sweep is not None else None
        return piece is not None and not self._link.has_credit(len(piece.data))

    def _next_piece(self) -> Column | None:
        """The next piece of a column, if there is one and credit for it."""
        if self._sweep is None or self._sweep.head is None or self._is_starved():
            return None
        return self._sweep.take()

    def _end_if_done(self) -> None:
        sweep = self._sweep
        if sweep is not None and sweep.owes_end and sweep.head is None and not self._table.is_moving:
            self.state = State.HOLDING
            sweep.owes_end = False
            self._link.send(sweep.end())
