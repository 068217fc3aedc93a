"""How the node is, for a monitor: one word, and what is wrong in words for people."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from node.capture import CaptureStatus
from node.durable import EASY_BYTES, free_bytes
from node.library import Library
from node.notify import Beating, stuck
from node.scan_folder import name_problems

STUCK_S = 30.0  # the slowest step of the capture thread takes 15
ENDS_SOON_S = 14 * 86400.0

Status = Literal["ready", "capturing", "degraded", "stopping"]


@dataclass(frozen=True, slots=True)
class Health:
    """ready: all is well; capturing: so it is, and a sweep runs; degraded: it serves, but not all that it should;
    stopping: it serves no longer.

    reasons : why it is not ready.
    """

    status: Status
    reasons: tuple[str, ...] = ()


def examine_health(
    capture: CaptureStatus,
    library: Library,
    parts: Mapping[str, Beating],
    audit_trouble: str = "",
    planning_trouble: str = "",
    certificate_end_unix_s: float | None = None,
    now_unix_s: float = 0.0,
) -> Health:
    """How the node is while it serves. Asks the disk, so it may take its time.

    parts : the threads that have to get on, by what they are called.  certificate_end_unix_s : None without one.
    """
    reasons = (
        *_of_scanner(capture),
        *filter(None, (stuck(parts, STUCK_S),)),
        *_of_disk(library),
        *_of_library(library),
        *filter(None, (library.axes.damaged,)),
        *((f"the audit log cannot be written: {audit_trouble}",) if audit_trouble else ()),
        *filter(None, (planning_trouble,)),
        *_of_certificate(certificate_end_unix_s, now_unix_s),
    )
    if reasons:
        return Health("degraded", reasons)
    return Health("capturing" if capture.phase == "sweeping" else "ready")


def _of_certificate(end_unix_s: float | None, now_unix_s: float) -> tuple[str, ...]:
    if end_unix_s is None or end_unix_s - now_unix_s > ENDS_SOON_S:
        return ()
    if end_unix_s <= now_unix_s:
        return ("the certificate has ended: clients refuse it",)
    return (f"the certificate ends in {(end_unix_s - now_unix_s) / 86400:.0f} days",)


def _of_scanner(capture: CaptureStatus) -> tuple[str, ...]:
    return (capture.refusal,) if capture.phase == "connecting" else ()


def _of_disk(library: Library) -> tuple[str, ...]:
    try:
        free = free_bytes(library.folder)
    except OSError as error:
        return (f"the library's disk: {error.strerror}",)
    return (f"the disk is nearly full: {free} bytes are free",) if free < EASY_BYTES else ()


def _of_library(library: Library) -> tuple[str, ...]:
    problems = library.problems
    return (f"the library holds what is no sound scan: {name_problems(problems)}",) if problems else ()
