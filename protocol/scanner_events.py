"""What happens on the scanner link, as its two ends are told: one class for each kind of event."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from protocol.framing import Dropped
from protocol.scanner_messages import (
    Calibrate,
    Calibration,
    Column,
    ColumnsGone,
    DeviceInfo,
    Fault,
    Hello,
    NakCode,
    RequestColumns,
    Reset,
    Status,
    SweepEnd,
    SweepHeader,
    SweepRequest,
    SweepStart,
    SweepStop,
)

HostCommand = Hello | Reset | SweepRequest | Calibrate | SweepStart | SweepStop | RequestColumns
DeviceCommand = Calibration | SweepHeader | SweepEnd | ColumnsGone | Fault
Sent = HostCommand | DeviceCommand


class Role(Enum):
    """Which end of the link this is."""

    HOST = "host"
    DEVICE = "device"


@dataclass(frozen=True, slots=True)
class Command:
    """The other end wants this done: `accept` or `refuse` it."""

    seq: int
    message: Sent


@dataclass(frozen=True, slots=True)
class Accepted:
    """Our command was accepted."""

    message: Sent


@dataclass(frozen=True, slots=True)
class Refused:
    """Our command was refused."""

    message: Sent
    code: NakCode
    text: str


@dataclass(frozen=True, slots=True)
class Unanswered:
    """Our command was sent five times and never answered."""

    message: Sent


@dataclass(frozen=True, slots=True)
class WrongVersion:
    """The other end speaks another major version; nothing but that can be understood."""

    major: int


Event = Command | Accepted | Refused | Unanswered | WrongVersion | Dropped | Hello | DeviceInfo | Status | Column
