"""Lines of the log: nobody forges one, a stranger who speaks no HTTP is worth one, a journal knows how bad it is."""

import json
import logging
import os
from pathlib import Path

import pytest
from aiohttp.http_exceptions import BadHttpMessage

from node.log import FORMAT, JournalFormatter, JsonFormatter, LineFormatter, formatter_for, without_traceback


def record(message: str, *args: object, problem: Exception | None = None, level: int = 40) -> logging.LogRecord:
    cause = (type(problem), problem, None) if problem else None
    return logging.LogRecord("node.x", level, "x.py", 1, message, args, cause)


def test_what_a_client_said_stays_on_its_line() -> None:
    line = LineFormatter(FORMAT).format(record("stream ended: %s", "x\nERROR node.daemon: forged \x1b[31m ä"))
    assert line == r"ERROR node.x: stream ended: x\nERROR node.daemon: forged \x1b[31m ä"


def test_what_is_no_http_is_a_warning_of_one_line_without_what_it_was() -> None:
    problem = BadHttpMessage("Bad header: Authorization: Bearer se\n\n\x00cret")
    said = record("Error handling request from %s", "127.0.0.1", problem=problem)
    assert without_traceback(said)
    assert LineFormatter(FORMAT).format(said) == "WARNING node.x: Error handling request from 127.0.0.1: BadHttpMessage"


def test_what_is_no_http_is_not_told_where_only_errors_are(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(logging.getLogger(), "level", logging.ERROR)
    assert not without_traceback(record("Error handling request", problem=BadHttpMessage("Bad method")))


def test_who_hangs_up_is_not_worth_a_line() -> None:
    assert not without_traceback(record("Error handling request", problem=ConnectionResetError("Connection lost")))


def test_a_bug_keeps_its_traceback() -> None:
    said = record("Error handling request", problem=ZeroDivisionError("by zero"))
    assert without_traceback(said)
    assert LineFormatter(FORMAT).format(said).splitlines() == [
        "ERROR node.x: Error handling request", "ZeroDivisionError: by zero",
    ]  # fmt: skip


def test_in_the_journal_every_line_has_its_priority() -> None:
    said = record("Error handling request", problem=ZeroDivisionError("by zero"))
    assert JournalFormatter(FORMAT).format(said) == (
        "<3>ERROR node.x: Error handling request\n<3>ZeroDivisionError: by zero"
    )
    levels = [JournalFormatter(FORMAT).format(record("x", level=level))[:3] for level in (50, 30, 20, 10)]
    assert levels == ["<3>", "<4>", "<6>", "<7>"]


def test_as_json_a_record_is_one_object() -> None:
    said = record('he said "%s"', "x\ny", problem=ZeroDivisionError("by zero"))
    line = JsonFormatter().format(said)
    assert "\n" not in line
    found = json.loads(line)
    assert found.pop("time").endswith("+00:00")
    assert found == {
        "level": "error", "logger": "node.x", "message": 'he said "x\ny"', "traceback": "ZeroDivisionError: by zero",
    }  # fmt: skip


def test_the_journal_is_recognised_by_the_file_it_gave_us(tmp_path: Path) -> None:
    with open(tmp_path / "stderr", "w") as file:
        info = os.fstat(file.fileno())
        journal = {"JOURNAL_STREAM": f"{info.st_dev}:{info.st_ino}"}
        assert type(formatter_for("auto", journal, file.fileno())) is JournalFormatter
        assert type(formatter_for("text", journal, file.fileno())) is LineFormatter
        assert type(formatter_for("json", journal, file.fileno())) is JsonFormatter
        assert type(formatter_for("auto", {}, file.fileno())) is LineFormatter
        assert type(formatter_for("auto", {"JOURNAL_STREAM": "8:1"}, file.fileno())) is LineFormatter
