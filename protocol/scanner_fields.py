"""What the messages of the scanner link are made of: bounded numbers, words, and the names of states and orders."""

from __future__ import annotations

import struct
from enum import IntEnum, IntFlag
from typing import Any, ClassVar, Self

from protocol.errors import LocalWireError

TEXT_MAX = 200  # bytes of UTF-8 in any text field
PASSES_MAX = 64

Payload = bytes | memoryview


class Channel(IntFlag):
    """What a sweep measures."""

    RANGE = 1
    TEXTURE = 2
    BOTH = 3


class Order(IntEnum):
    """In which order a scanner sends its columns."""

    LIVE = 0  # by angle, as the table turns
    BUFFERED = 1  # from its memory, coarse to fine


class State(IntEnum):
    """What a scanner is doing."""

    IDLE = 0
    HOMING = 1
    SWEEPING = 2
    HOLDING = 3  # the sweep is over and its columns are still held for requests
    FAULT = 4


class Outcome(IntEnum):
    """How a sweep ended."""

    COMPLETE = 0
    STOPPED = 1
    FAULT = 2


class NakCode(IntEnum):
    """Why a command was refused."""

    VERSION = 1
    UNKNOWN = 2
    MALFORMED = 3
    BUSY = 4
    UNSUPPORTED = 5
    NOT_NOW = 6
    FAULT = 7


class Plain:
    """A message whose fields lie on the line one after the other, each with its place in the layout."""

    __slots__ = ()
    _LAYOUT: ClassVar[struct.Struct]
    __match_args__: ClassVar[tuple[str, ...]]

    def to_bytes(self) -> bytes:
        """As the message's table."""
        return self._LAYOUT.pack(*(getattr(self, name) for name in self.__match_args__))

    @classmethod
    def from_bytes(cls, payload: Payload) -> Self:
        """Inverse of to_bytes."""
        return cls(*unpack(cls._LAYOUT, payload))


def check(good: bool, complaint: str) -> None:
    """Raise ValueError unless a field is within its bounds."""
    if not good:
        raise ValueError(complaint)


def unpack(layout: struct.Struct, payload: Payload) -> tuple[Any, ...]:
    """The fields at the beginning of a payload. Raises ValueError where it is too short."""
    check(len(payload) >= layout.size, f"{len(payload)} bytes, needs {layout.size}")
    return layout.unpack_from(payload)


def unpack_appended(
    layout: struct.Struct, payload: Payload, at: int, absent: tuple[int, ...]
) -> tuple[Any, ...]:
    """Fields that a newer minor version appended, or what their absence means."""
    return layout.unpack_from(payload, at) if len(payload) >= at + layout.size else absent


def channels_from(value: int) -> Channel:
    """What a sweep measures, as it travels. Raises ValueError."""
    check(value in (1, 2, 3), f"channels {value}")
    return Channel(value)


def passes_from(value: int) -> int:
    """A number of passes. Raises ValueError."""
    check(1 <= value <= PASSES_MAX, f"passes {value}")
    return value


def text_to_bytes(text: str) -> bytes:
    """Words behind their length. Raises LocalWireError where they are too long."""
    data = text.encode()
    if len(data) > TEXT_MAX:
        raise LocalWireError(f"text of {len(data)} bytes, at most {TEXT_MAX} travel")
    return bytes([len(data)]) + data


def text_from_bytes(payload: Payload, at: int) -> tuple[str, int]:
    """The text at this place, and the place behind it."""
    check(len(payload) > at, "text is missing")
    size = payload[at]
    end = at + 1 + size
    check(size <= TEXT_MAX and len(payload) >= end, f"text of {size} bytes does not fit")
    return bytes(payload[at + 1 : end]).decode(), end
