"""What every port to a scanner offers, whatever carries the bytes."""

from __future__ import annotations

from typing import Protocol


class Port(Protocol):
    """An open line to a scanner, used by one thread; only `cancel` may be called from another.

    Every method raises PortLost when the line or the device behind it is gone, and goes on raising it.
    """

    @property
    def name(self) -> str:
        """What a person calls this port, for messages."""
        ...

    def read(self, max_bytes: int, timeout_s: float) -> bytes:
        """Whatever has arrived, at most `max_bytes`; waits up to `timeout_s` for the first byte.

        Returns b"" only when the time is over or `cancel` was called.
        """
        ...

    def write(self, data: bytes) -> None:
        """Send all of `data`."""
        ...

    def cancel(self) -> None:
        """Make the pending read, or else the next one, return at once."""
        ...

    def close(self) -> None:
        """Let go of the line; harmless when repeated or when the device is gone."""
        ...
