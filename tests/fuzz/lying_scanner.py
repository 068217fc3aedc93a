"""What stands at the far end of a scanner's line: a device that lies, and an honest one after it."""

from __future__ import annotations

import random
import threading
from typing import Protocol

from protocol.framing import Frame, FrameReader, encode_frame
from protocol.scanner_messages import DeviceInfo, Hello, encode_message
from simulators.carriers import ServedPort, serve
from simulators.scanner import SimulatedScanner
from simulators.specimen import make_specimen
from simulators.turntable import Turntable
from tests.fuzz.mutation import mutant
from tests.protocol.test_scanner_messages import TABLE

FRAMES_AT_ONCE = 20
END_S = 10.0


class Campaign(Protocol):
    """What it needs to know of it. first : seeds what it says."""

    first: int

    @property
    def is_done(self) -> bool:
        """Whether it is over."""

    def add(self, sent: int) -> None:
        """So many more."""


class LyingScanner:
    """A device in a thread of its own that greets as it should, mostly, and lies ever after."""

    def __init__(self, port: ServedPort, campaign: Campaign, payload_max: int) -> None:
        self._port = port
        self._campaign = campaign
        self._payload_max = payload_max
        self._draw = random.Random(campaign.first)
        self._reader = FrameReader(payload_max)
        self._session = 1
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="lying scanner", daemon=True)

    def __enter__(self) -> None:
        self._thread.start()

    def __exit__(self, *of: object) -> None:
        self._ended.set()
        self._port.cancel()
        self._thread.join(END_S)

    def _run(self) -> None:
        seeds = [(message.TYPE, encode_message(message)) for message, _ in TABLE]
        while not self._ended.is_set() and not self._campaign.is_done:
            self._listen()
            frames = []
            for _ in range(FRAMES_AT_ONCE):
                kind, payload = self._draw.choice(seeds)
                payload = mutant((payload,), self._draw)[: self._payload_max]
                frame = encode_frame(kind, payload, seq=self._draw.randrange(64), session=self._session)
                frames.append(mutant((frame,), self._draw) if self._draw.random() < 0.3 else frame)
            self._port.write(b"".join(frames))
            self._campaign.add(FRAMES_AT_ONCE)

    def _listen(self) -> None:
        """Answer a greeting, three times of four."""
        self._reader.receive_data(self._port.read(65536, 0.0))
        while (event := self._reader.next_event()) is not None:
            if isinstance(event, Frame) and event.type == Hello.TYPE:
                self._session = event.session
                if self._draw.random() < 0.75:
                    said = encode_message(DeviceInfo("A7", 5, 1000, 100))
                    self._port.write(encode_frame(DeviceInfo.TYPE, said, seq=0, session=event.session))


class HonestScanner:
    """A simulated one, in a thread of its own."""

    def __init__(self, port: ServedPort, payload_max: int) -> None:
        table = Turntable(make_specimen("sphere", "S", None, 0), turn_s=0.2)
        self._scanner = SimulatedScanner(table, payload_max=payload_max)
        self._port = port
        self._ended = threading.Event()
        self._thread = threading.Thread(target=serve, args=(self._scanner, port, self._ended), daemon=True)

    def __enter__(self) -> None:
        self._thread.start()

    def __exit__(self, *of: object) -> None:
        self._ended.set()
        self._port.cancel()
        self._thread.join(END_S)
