"""How the node is, for a monitor: one word, and what is wrong in words for people."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from node.capture import CaptureStatus
from node.durable import EASY_BYTES, free_bytes
from node.library import Library
from node.scan_folder import name_problems


@dataclass(frozen=True, slots=True)
class Health:
    """ready: all is well; degraded: it serves, but not all that it should; stopping: it serves no longer.

    reasons : why it is not ready.
    """

    status: Literal["ready", "degraded", "stopping"]
    reasons: tuple[str, ...] = ()


def examine_health(capture: CaptureStatus, library: Library) -> Health:
    """How the node is while it serves. Asks the disk, so it may take its time."""
    reasons = (*_of_scanner(capture), *_of_disk(library), *_of_library(library))
    return Health("degraded" if reasons else "ready", reasons)


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
