"""udev's words: tells programs under libumockdev's preload that a device came or went, as udevd's socket would."""

from __future__ import annotations

import socket
import struct
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

_MAGIC = 0xFEEDCAFE
_HASH_FACTOR = 0x5BD1E995


def announce(root: Path, action: str, properties: Mapping[str, str]) -> None:
    """Send "add" or "remove" to every monitor that listens under `root`."""
    told = {"ACTION": action, **properties, "SEQNUM": "1", "USEC_INITIALIZED": "1"}
    body = b"".join(f"{key}={value}\0".encode() for key, value in told.items())
    subsystem, kind = properties["SUBSYSTEM"], properties.get("DEVTYPE", "")
    hashes = string_hash(subsystem.encode()), string_hash(kind.encode()) if kind else 0
    head = b"libudev\0" + struct.pack(">I", _MAGIC) + struct.pack("=III", 40, 40, len(body))
    message = head + struct.pack(">IIII", *hashes, 0, 0) + body
    for path in root.glob("event[0-9]*"):
        with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_RAW) as monitor:  # it may be gone
            monitor.connect(str(path))
            monitor.send(message)


def string_hash(data: bytes) -> int:
    """MurmurHash2 with seed 0, by which libudev filters events."""
    size = len(data)
    value = size
    whole = size - size % 4
    for (word,) in struct.iter_unpack("<I", data[:whole]):
        word = word * _HASH_FACTOR & 0xFFFFFFFF
        word = (word ^ word >> 24) * _HASH_FACTOR & 0xFFFFFFFF
        value = value * _HASH_FACTOR & 0xFFFFFFFF ^ word
    if size % 4:
        value = (value ^ int.from_bytes(data[whole:], "little")) * _HASH_FACTOR & 0xFFFFFFFF
    value = (value ^ value >> 13) * _HASH_FACTOR & 0xFFFFFFFF
    return value ^ value >> 15
