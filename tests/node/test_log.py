"""Lines of the node's log: nobody forges one, and a stranger who speaks no HTTP is worth one."""

import logging

from aiohttp.http_exceptions import BadHttpMessage

from node.log import FORMAT, LineFormatter, without_traceback


def record(message: str, *args: object, problem: Exception | None = None) -> logging.LogRecord:
    cause = (type(problem), problem, None) if problem else None
    return logging.LogRecord("node.x", logging.ERROR, "x.py", 1, message, args, cause)


def test_what_a_client_said_stays_on_its_line() -> None:
    line = LineFormatter(FORMAT).format(record("stream ended: %s", "x\nERROR node.daemon: forged \x1b[31m ä"))
    assert line == r"ERROR node.x: stream ended: x\nERROR node.daemon: forged \x1b[31m ä"


def test_what_is_no_http_is_a_warning_of_one_line() -> None:
    said = record("Error handling request from %s", "127.0.0.1", problem=BadHttpMessage("Bad\n\n  method"))
    assert without_traceback(said)
    assert LineFormatter(FORMAT).format(said) == "WARNING node.x: Error handling request from 127.0.0.1: Bad method"


def test_a_bug_keeps_its_traceback() -> None:
    said = record("Error handling request", problem=ZeroDivisionError("by zero"))
    assert without_traceback(said)
    assert LineFormatter(FORMAT).format(said).splitlines() == [
        "ERROR node.x: Error handling request", "ZeroDivisionError: by zero",
    ]  # fmt: skip
