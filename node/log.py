"""The node's log: one line a record on standard error, where systemd's journal takes it up.

What others wrote (a message of a client, the name of a scan, a header of HTTP) cannot forge a line. What a stranger
sends to the port that is no HTTP is one line too, no traceback: it is no fault of ours.
"""

from __future__ import annotations

import logging

from aiohttp.http_exceptions import HttpProcessingError

from protocol.printable import printable

FORMAT = "%(levelname)s %(name)s: %(message)s"


class LineFormatter(logging.Formatter):
    """A record as one line; a traceback, where there is one, follows in lines of its own."""

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: D102  # as logging has it
        return printable(super().formatMessage(record))


def without_traceback(record: logging.LogRecord) -> bool:
    """A filter for aiohttp's server: a request that is no HTTP becomes a warning. Lets every record pass."""
    problem = record.exc_info[1] if record.exc_info else None
    if isinstance(problem, HttpProcessingError):
        record.levelno, record.levelname = logging.WARNING, "WARNING"
        record.msg, record.args = "%s: %s", (record.getMessage(), " ".join(problem.message.split()))
        record.exc_info = None
    return True


def set_level(level: str) -> None:
    """From how bad on a record is told: "debug", "info", "warning" or "error"."""
    logging.getLogger().setLevel(level.upper())


def start_log() -> None:
    """Begin to log."""
    handler = logging.StreamHandler()
    handler.setFormatter(LineFormatter(FORMAT))
    logging.basicConfig(level=logging.INFO, handlers=[handler])
    logging.getLogger("aiohttp.server").addFilter(without_traceback)
