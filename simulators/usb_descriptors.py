"""What a simulated USB scanner says about itself when it is plugged in."""

from __future__ import annotations

import struct
from dataclasses import dataclass

PACKET_BYTES = 512  # of a bulk endpoint at high speed
BULK_IN, BULK_OUT = 0x81, 0x01
_BULK = 2
_VENDOR_CLASS = 0xFF
_LANGUAGES = struct.pack("<BBH", 4, 3, 0x0409)


@dataclass(frozen=True, slots=True)
class UsbIdentity:
    """Ids and names of a device; the ids are pid.codes' for tests."""

    vendor: int = 0x1209
    product: int = 0x5CA1
    manufacturer: str = "foveascan"
    model: str = "Simulated turntable scanner"
    serial_number: str = "SIM-0001"

    @property
    def address(self) -> str:
        """What `foveascan serve --scanner` takes."""
        return f"usb:{self.vendor:04x}:{self.product:04x}"

    def device_descriptor(self) -> bytes:
        """18 bytes, as the kernel shows them."""
        ids = (self.vendor, self.product, 0x0100)
        return struct.pack("<BBHBBBBHHHBBBB", 18, 1, 0x0200, _VENDOR_CLASS, 0, 0, 64, *ids, 1, 2, 3, 1)

    def configuration_descriptor(self) -> bytes:
        """One configuration, one interface, bulk in and bulk out."""
        body = bulk_interface() + bulk_endpoint(BULK_IN, PACKET_BYTES) + bulk_endpoint(BULK_OUT, PACKET_BYTES)
        return struct.pack("<BBHBBBBB", 9, 2, 9 + len(body), 1, 1, 0, 0x80, 250) + body

    def string_descriptor(self, index: int) -> bytes | None:
        """String number `index`, or None where there is none."""
        if index == 0:
            return _LANGUAGES
        texts = (self.manufacturer, self.model, self.serial_number)
        if not 1 <= index <= len(texts):
            return None
        data = texts[index - 1].encode("utf-16le")
        return struct.pack("BB", len(data) + 2, 3) + data


CDC_IDENTITY = UsbIdentity(product=0x5CA2)  # of a scanner that is a serial port


def bulk_interface() -> bytes:
    """Interface 0, with a bulk endpoint each way."""
    return struct.pack("<BBBBBBBBB", 9, 4, 0, 0, 2, _VENDOR_CLASS, 0, 0, 0)


def bulk_endpoint(address: int, packet_bytes: int) -> bytes:
    """One end of it."""
    return struct.pack("<BBBBHB", 7, 5, address, _BULK, packet_bytes, 0)
