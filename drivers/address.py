"""How a setting names a scanner's port: a path, serial:VID:PID[:SERIAL], usb:VID:PID[:SERIAL] or tcp:HOST:PORT."""

from __future__ import annotations

import re

_IDS = re.compile("(usb|serial):([0-9a-fA-F]{1,4}):([0-9a-fA-F]{1,4})(?::(.+))?")
_TCP = re.compile(r"tcp:(?:\[([0-9A-Fa-f:.%\w]+)\]|([^\s:\[\]/]{1,253})):([0-9]{1,5})")


def check_address(address: str) -> None:
    """Raise ValueError for an address that can lead to no port, whatever is plugged in."""
    kind = address.partition(":")[0]
    if kind == "tcp":
        parse_tcp(address)
    elif kind in ("usb", "serial"):
        parse_ids(kind, address)


def parse_ids(kind: str, address: str) -> tuple[int, int, str | None]:
    """Vendor id, product id and serial number, if it names one, of KIND:VID:PID[:SERIAL]. Raises ValueError."""
    match = _IDS.fullmatch(address)
    if match is None or match[1] != kind:
        expected = f"{kind}:VENDOR:PRODUCT or {kind}:VENDOR:PRODUCT:SERIAL, ids in hexadecimal"
        raise ValueError(f"{address!r} is not {expected}")
    return int(match[2], 16), int(match[3], 16), match[4]


def parse_tcp(address: str) -> tuple[str, int]:
    """Host and port of tcp:HOST:PORT or tcp:[IPv6]:PORT. Raises ValueError."""
    match = _TCP.fullmatch(address)
    if match is None or not 1 <= int(match[3]) <= 65535:
        raise ValueError(f"{address!r} is not tcp:HOST:PORT or tcp:[IPv6]:PORT")
    return match[1] or match[2], int(match[3])
