"""The node's log on standard error, one line a record: as text, for systemd's journal, or as JSON.

What others wrote (a message of a client, the name of a scan, a header of HTTP) cannot forge a line. What a stranger
sends to the port that is no HTTP is one line too, with nothing of what it was. No line has a name, a subject, a token
or anything of a scan: whose doings they are is in the audit log (node.audit). In the journal every line begins with its
priority, as sd-daemon(3) has it, so `journalctl -p warning` finds what matters.
"""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Literal

import msgspec
from aiohttp.http_exceptions import HttpProcessingError

from protocol.printable import printable

Format = Literal["auto", "text", "json"]

FORMAT = "%(levelname)s %(name)s: %(message)s"
PRIORITIES = ((logging.ERROR, 3), (logging.WARNING, 4), (logging.INFO, 6), (0, 7))  # of syslog


class LineFormatter(logging.Formatter):
    """A record as one line; a traceback, where there is one, follows in lines of its own."""

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: D102  # as logging has it
        return printable(super().formatMessage(record))


class JournalFormatter(LineFormatter):
    """The same with the priority before every line."""

    def format(self, record: logging.LogRecord) -> str:  # noqa: D102  # as logging has it
        priority = next(number for level, number in PRIORITIES if record.levelno >= level)
        return "\n".join(f"<{priority}>{line}" for line in super().format(record).splitlines())


class JsonFormatter(logging.Formatter):
    """A record as one JSON object: time, level, logger, message, and traceback where there is one."""

    def format(self, record: logging.LogRecord) -> str:  # noqa: D102  # as logging has it
        said = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
        }
        if record.exc_info:
            said["traceback"] = self.formatException(record.exc_info)
        return msgspec.json.encode(said).decode()


def without_traceback(record: logging.LogRecord) -> bool:
    """A filter for aiohttp's server: a request that is no HTTP becomes a warning, one that was cut off nothing.

    What the request was stays out: a header that cannot be read may be the one with the token.
    """
    problem = record.exc_info[1] if record.exc_info else None
    if isinstance(problem, ConnectionError):
        return False
    if isinstance(problem, HttpProcessingError):
        record.levelno, record.levelname = logging.WARNING, "WARNING"
        record.msg, record.args = "%s: %s", (record.getMessage(), type(problem).__name__)
        record.exc_info = None
    return record.levelno >= logging.getLogger().level


def formatter_for(wanted: Format, environ: Mapping[str, str], stderr_descriptor: int) -> logging.Formatter:
    """How to write records. "auto" is for the journal where standard error leads there, and text elsewhere."""
    if wanted == "json":
        return JsonFormatter()
    if wanted == "auto" and leads_to_journal(environ, stderr_descriptor):
        return JournalFormatter(FORMAT)
    return LineFormatter(FORMAT)


def leads_to_journal(environ: Mapping[str, str], descriptor: int) -> bool:
    """Whether a file is the one that systemd connected to its journal (JOURNAL_STREAM, systemd.exec(5))."""
    try:
        info = os.fstat(descriptor)
    except OSError:
        return False
    return environ.get("JOURNAL_STREAM") == f"{info.st_dev}:{info.st_ino}"


def set_log(level: str, wanted: Format) -> None:
    """From how bad on a record is told ("debug", "info", "warning" or "error"), and in which form."""
    root = logging.getLogger()
    root.setLevel(level.upper())
    for handler in root.handlers:
        handler.setFormatter(formatter_for(wanted, os.environ, sys.stderr.fileno()))


def start_log() -> None:
    """Begin to log."""
    logging.basicConfig(level=logging.INFO, handlers=[logging.StreamHandler()])
    set_log("info", "auto")
    logging.getLogger("aiohttp.server").addFilter(without_traceback)
