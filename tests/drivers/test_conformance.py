"""The checks for firmware authors: a good device passes them all, and each fault is named by the check it is for."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from drivers.conformance import Finding, examine_link
from protocol.framing import Frame
from protocol.grid import Grid, GridSpec, ImageArray, StepArray
from protocol.scanner_link import Event, ScannerLink
from protocol.scanner_messages import Channel, Hello
from simulators.carriers import Line, MemoryPort, clean_line
from simulators.scanner import APART, SimulatedScanner
from simulators.specimen import Specimen
from simulators.turntable import Exposure, Turntable

SPEC = GridSpec(32, 200, 64, 300, 0.01, 1.0)


def device(**kinds: Any) -> SimulatedScanner:
    rng = np.random.default_rng(5)
    steps = rng.integers(1, 60000, (SPEC.height, SPEC.width)).astype(np.uint16)
    texture = rng.integers(0, 256, (SPEC.texture_height, SPEC.texture_width, 3)).astype(np.uint8)
    return SimulatedScanner(Turntable(Specimen("noise", Grid(SPEC, steps, texture)), turn_s=0.2), **kinds)


def examined(scanner: SimulatedScanner, to_node: Line = clean_line) -> dict[str, Finding]:
    port = MemoryPort(scanner, to_node=to_node)
    return {finding.check: finding for finding in examine_link(port, clock=port.clock)}


def problems(findings: dict[str, Finding]) -> set[str]:
    return {name for name, finding in findings.items() if finding.state == "problem"}


def test_a_device_that_follows_the_protocol_passes_every_check() -> None:
    findings = examined(device())
    assert problems(findings) == set() and len(findings) == 14
    assert "SIM-0001" in findings["greeting"].found


def test_a_device_of_one_camera_at_a_time_passes_every_check() -> None:
    findings = examined(device(channels=APART))
    assert problems(findings) == set() and len(findings) == 14
    assert findings["channels of one turn"].found == "each in a turn of its own"
    assert findings["a sweep"].found.count("digest agrees") == 2


def test_a_device_without_texture_is_told_so_and_checked_no_further() -> None:
    *_, last = examined(device(channels=(Channel.RANGE,))).values()
    assert (last.check, last.state) == ("channels of one turn", "problem") and "code 5" in last.cure


def test_a_silent_port_is_one_problem_with_a_hint() -> None:
    findings = examined(device(), lambda data: b"")
    assert list(findings) == ["greeting"] and "baud" in findings["greeting"].cure



def _answers_every_session(link: ScannerLink) -> None:
    take = link._take_frame

    def take_any(frame: Frame) -> Event | None:
        return take(frame if frame.type == Hello.TYPE else frame._replace(session=link._session))

    link._take_frame = take_any  # type: ignore[method-assign]


def _refuses_with_the_wrong_code(link: ScannerLink) -> None:
    reject = link._reject
    link._reject = lambda frame, reason, code, text: reject(frame, reason, type(code)(4), text)  # type: ignore[method-assign]


@pytest.mark.parametrize(
    ("spoil", "named"),
    [
        (_answers_every_session, "frames of another session"),
        (_refuses_with_the_wrong_code, "an unknown command"),
    ],
)
def test_a_device_that_breaks_a_rule_is_told_which(spoil: Callable[[ScannerLink], None], named: str) -> None:
    scanner = device()
    spoil(scanner._link)
    assert named in problems(examined(scanner))


def test_a_column_that_changes_when_sent_again_is_noticed() -> None:
    scanner = device()
    samples, seen = scanner._table.samples, set[tuple[Channel, int, int]]()

    def other(exposure: Exposure) -> StepArray | ImageArray:
        column, name = samples(exposure), (exposure.channel, exposure.column, exposure.time_us)
        again = name in seen
        seen.add(name)
        return column[::-1].copy() if again else column

    scanner._table.samples = other  # type: ignore[method-assign]
    assert "columns sent again" in problems(examined(scanner))
