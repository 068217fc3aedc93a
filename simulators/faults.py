"""A scanner on a bad day: a line that spoils frames, and a device that resets, unplugs or speaks another version.

`FaultyScanner` stands where a carrier expects a SimulatedScanner and spoils what passes, the same way for a seed.
Faults are named on the command line as `flip=0.01,stall=2`; `parse_faults` knows every name and its unit.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields

import numpy as np

from protocol.errors import UsageError
from protocol.framing import FRAME_OVERHEAD, encode_frame
from protocol.grid import HEIGHT_MAX, STEPS_MAX, WIDTH_MAX
from protocol.scanner_messages import DeviceInfo, RangeColumn, SweepHeader, TextureColumn
from simulators.flaws import Flaws
from simulators.scanner import SimulatedScanner

_HEADER_BYTES = 16
_COLUMN_TYPES = (RangeColumn.TYPE, TextureColumn.TYPE)
_LOST_BYTES_MAX = 40
_BURST_BYTES_MAX = 600
_HELD_BACK_FRAMES = 4
_NEWER_MINOR = 9
_OTHER_MAJOR = 2
_UNKNOWN_TYPE = 0x77


@dataclass(frozen=True, slots=True)
class Faults:
    """What goes wrong on the line and in the device. Shares are of frames, in both directions for the first three.

    loss, flip, burst : frames that lose bytes, get a bit turned, or are followed by noise.    truncate, lie, twice,
    reorder : frames to the node that stop early, name a wrong length, come twice, or come behind later ones (the last
    two only columns).    dribble : most bytes that arrive at once.    stall : seconds that the line once falls silent.
    reset : 1 makes the device start anew once.    unplug : seconds that the plug is out once, from the middle of a
    column on.    minor, major : 1 makes the device speak a newer minor or another major version.
    """

    loss: float = 0.0
    flip: float = 0.0
    burst: float = 0.0
    truncate: float = 0.0
    lie: float = 0.0
    twice: float = 0.0
    reorder: float = 0.0
    dribble: float = 0.0
    stall: float = 0.0
    reset: float = 0.0
    unplug: float = 0.0
    minor: float = 0.0
    major: float = 0.0


_FLAW_NAMES = {
    "reversed": "is_reversed", "ticks": "lost_ticks", "slip": "slip_turns", "nudge": "nudge_turns",
    "overshoot": "overshoot_turns", "dead": "dead_rows", "saturated": "saturated_columns", "spikes": "spikes",
    "dropouts": "dropouts", "noise": "noise_steps",
}  # fmt: skip
FAULT_NAMES = tuple(field.name for field in fields(Faults)) + tuple(_FLAW_NAMES)
_MOST = {
    "stall": 3600, "unplug": 3600, "overshoot": 10, "noise": STEPS_MAX,
    "dribble": 2**16, "ticks": 2**31 - 1, "dead": HEIGHT_MAX, "saturated": WIDTH_MAX,
}  # fmt: skip
_COUNTS = ("dribble", "ticks", "dead", "saturated", "reset", "minor", "major", "reversed")


def parse_faults(text: str, seed: int = 0) -> tuple[Faults, Flaws]:
    """What "loss=0.01,spikes=0.001" asks for: faults of line and device, flaws of table and cameras.

    Raises UsageError for a name or a number that makes no sense.
    """
    faults, flaws = Faults(), Flaws(seed=seed)
    seen: set[str] = set()
    for item in filter(None, text.split(",")):
        name, _, given = item.strip().partition("=")
        if name not in FAULT_NAMES:
            raise UsageError(f"faults: {name!r} is none of {', '.join(FAULT_NAMES)}")
        if name in seen:
            raise UsageError(f"faults: {name} is given twice")
        seen.add(name)
        value = _number(name, given or "1")
        if name in _FLAW_NAMES:
            place = _FLAW_NAMES[name]
            kind = type(getattr(flaws, place))
            flaws = dataclasses.replace(flaws, **{place: kind(value)})
        else:
            faults = dataclasses.replace(faults, **{name: value})
    return faults, flaws


def _number(name: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise UsageError(f"faults: {name}={text!r} is no number") from None
    least, most = (1 if name == "dribble" else 0), _MOST.get(name, 1)
    if not least <= value <= most or (name in _COUNTS and not value.is_integer()):
        kind = "a whole number" if name in _COUNTS else "a number"
        raise UsageError(f"faults: {name}={text} is not {kind} between {least} and {most}")
    return value


class Unplugged(Exception):
    """The plug is pulled: the carrier delivers `data` and hangs up for `away_s` seconds."""

    def __init__(self, data: bytes, away_s: float) -> None:
        super().__init__(f"unplugged for {away_s:g} s")
        self.data = data
        self.away_s = away_s


class FaultyScanner:
    """What a carrier talks to, with faults on the way.

    boot : makes the device, given its boot id; called again when it resets.
    Stall, reset and unplug happen once, somewhere in the first sweep, or in its second turn.
    """

    def __init__(self, boot: Callable[[int], SimulatedScanner], faults: Faults, seed: int = 0) -> None:
        self._boot = boot
        self._faults = faults
        self._rng = np.random.default_rng(seed)
        self._boots = 1
        self.device = boot(self._boots)
        self.portion_bytes = int(faults.dribble) or None
        self._mishap_in: int | None = None  # columns to go until the one mishap; below 0 it has been
        self._silent_until_s = 0.0
        self._delayed = b""
        self._held_back: list[tuple[int, bytes]] = []
        self._now_s = 0.0

    def receive_data(self, data: bytes, now_s: float) -> None:
        """As SimulatedScanner.receive_data, after what the line does to it."""
        spoiled = b"".join(self._spoil(frame) for frame in split_frames(data))
        if spoiled:
            self.device.receive_data(spoiled, now_s)

    def step(self, now_s: float) -> None:
        """As SimulatedScanner.step."""
        self._now_s = now_s
        self.device.step(now_s)

    def wait_s(self, now_s: float) -> float:
        """As SimulatedScanner.wait_s."""
        if now_s < self._silent_until_s:
            return self._silent_until_s - now_s
        return self.device.wait_s(now_s)

    def data_to_send(self, max_bytes: int) -> bytes:
        """As SimulatedScanner.data_to_send, after what the line does to it. Raises Unplugged."""
        if self._now_s < self._silent_until_s:
            return b""
        sent, self._delayed = self._delayed, b""
        frames = list(split_frames(self.device.data_to_send(max_bytes)))
        for number, frame in enumerate(frames):
            if self._is_mishap(frame):
                rest = b"".join(frames[number:])
                return self._have_mishap(sent, frame, rest)
            sent += self._deliver(self._translated(frame))
        return sent if frames or sent else self._release(all_of_it=True)

    # -- once in a sweep -----------------------------------------------------------------------------------------

    def _is_mishap(self, frame: bytes) -> bool:
        """Whether now is the time for what happens once."""
        if not (self._faults.stall or self._faults.reset or self._faults.unplug):
            return False
        if frame[3] == SweepHeader.TYPE and self._mishap_in is None:
            header = SweepHeader.from_bytes(frame[_HEADER_BYTES:-4])
            columns = header.passes * (header.spec.width + header.spec.texture_width)
            self._mishap_in = int(columns * self._rng.uniform(0.15, 0.85))
        if frame[3] not in _COLUMN_TYPES or self._mishap_in is None:
            return False
        self._mishap_in -= 1
        return self._mishap_in == 0

    def _have_mishap(self, sent: bytes, frame: bytes, rest: bytes) -> bytes:
        faults = self._faults
        if faults.stall:
            self._silent_until_s, self._delayed = self._now_s + faults.stall, rest
            return sent
        if faults.reset:
            self._boots += 1
            self.device = self._boot(self._boots)
            self.device.step(self._now_s)
            return sent
        raise Unplugged(sent + frame[: len(frame) // 2], faults.unplug)

    # -- frame by frame ------------------------------------------------------------------------------------------

    def _deliver(self, frame: bytes) -> bytes:
        """One frame to the node, and those held back that are due behind it."""
        is_column = frame[3] in _COLUMN_TYPES
        if is_column and self._happens(self._faults.reorder):
            self._held_back.append((_HELD_BACK_FRAMES, frame))
            return b""
        data = self._spoil(self._shorten(frame))
        if is_column and self._happens(self._faults.twice):
            data += frame
        return data + self._release(all_of_it=not is_column)

    def _release(self, all_of_it: bool) -> bytes:
        """Columns held back whose time has come; nothing else overtakes them."""
        due = b"".join(frame for left, frame in self._held_back if all_of_it or left <= 1)
        self._held_back = [] if all_of_it else [(left - 1, frame) for left, frame in self._held_back if left > 1]
        return due

    def _shorten(self, frame: bytes) -> bytes:
        """A frame that stops early, or that names a wrong length under a right header checksum."""
        if self._happens(self._faults.truncate):
            return frame[: int(self._rng.integers(1, len(frame)))]
        if self._happens(self._faults.lie):
            claimed = int(self._rng.choice([0, 1, 1024, 8192, 65535]))
            head = encode_frame(frame[3], bytes(claimed), **_numbers(frame))[:_HEADER_BYTES]
            return head + frame[_HEADER_BYTES:]
        return frame

    def _spoil(self, frame: bytes) -> bytes:
        """Bytes lost, bits turned, noise behind it."""
        if self._happens(self._faults.loss):
            at, size = int(self._rng.integers(len(frame))), int(self._rng.integers(1, _LOST_BYTES_MAX))
            frame = frame[:at] + frame[at + size :]
        if frame and self._happens(self._faults.flip):
            at, bit = int(self._rng.integers(len(frame))), int(self._rng.integers(8))
            frame = frame[:at] + bytes([frame[at] ^ 1 << bit]) + frame[at + 1 :]
        if self._happens(self._faults.burst):
            frame += self._rng.bytes(int(self._rng.integers(1, _BURST_BYTES_MAX)))
        return frame

    def _translated(self, frame: bytes) -> bytes:
        """A frame as a device of another version would send it."""
        numbers, payload = _numbers(frame), frame[_HEADER_BYTES:-4]
        if self._faults.major:
            return encode_frame(frame[3], payload, **(numbers | {"version": _OTHER_MAJOR}))
        if not self._faults.minor or frame[3] in _COLUMN_TYPES:
            return frame
        if frame[3] == DeviceInfo.TYPE:
            payload = payload[:1] + bytes([_NEWER_MINOR]) + payload[2:]
        stranger = encode_frame(_UNKNOWN_TYPE, b"news", **(numbers | {"flags": 0}))
        return encode_frame(frame[3], payload + b"appended", **numbers) + stranger

    def _happens(self, share: float) -> bool:
        return share > 0 and float(self._rng.random()) < share


def split_frames(data: bytes) -> Iterator[bytes]:
    """The frames of undamaged bytes, each with its header and checksum."""
    at = 0
    while at < len(data):
        end = at + FRAME_OVERHEAD + int.from_bytes(data[at + 12 : at + 14], "little")
        yield data[at:end]
        at = end


def _numbers(frame: bytes) -> dict[str, int]:
    """What encode_frame needs to make this frame's header again."""
    session, seq = int.from_bytes(frame[6:8], "little"), int.from_bytes(frame[8:12], "little")
    return {"seq": seq, "session": session, "flags": frame[4], "version": frame[2]}
