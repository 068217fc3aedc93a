"""The subcommand `scan`: have the node sweep once, and wait for the scan."""

from __future__ import annotations

import argparse
import json
import sys
from typing import TYPE_CHECKING

from client.arguments import add_node, chosen_node
from protocol.printable import printable

if TYPE_CHECKING:
    from collections.abc import Iterator

    from client.session import Session
    from protocol.quality import FoundAxis, ScanQuality

POLL_S = 0.2
AWAY_S = 35.0  # a node goes on by itself with a sweep that was cut for half a minute ...
BACK_S = 5.0  # ... as soon as the same scanner is there


def add_subcommands(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Offer `scan`."""
    scan = subparsers.add_parser("scan", help="start a sweep and wait until the scan is published")
    add_node(scan)
    scan.set_defaults(run=run_scan)


def run_scan(args: argparse.Namespace) -> int:
    """Sweep once; print the new scan's id and quality."""
    import asyncio

    scan, quality = asyncio.run(_scan(args))
    if args.json:
        print(json.dumps({"scan": scan, "quality": record_of(quality) if quality else None}), flush=True)
        return 0
    print(f"scan {printable(scan)}", flush=True)
    for line in _in_words(quality) if quality else ():
        print(line, flush=True)
    return 0


def record_of(said: ScanQuality | FoundAxis) -> dict[str, object]:
    """What a node said, as --json prints it."""
    from msgspec.structs import asdict

    return {**asdict(said), "axis": asdict(said.axis) if said.axis else None}


def _in_words(quality: ScanQuality) -> Iterator[str]:
    """What a person should know of a scan, a line each."""
    noise = "" if quality.noise_mm is None else f", noise {quality.noise_mm:.3g} mm"
    yield f"coverage {100 * quality.coverage:.1f} %{noise}, {quality.holes} void cells in holes"
    if quality.axis is not None:
        yield f"corrected for an axis {quality.axis.in_words} off"
    yield from (printable(complaint) for complaint in quality.complaints)


async def _scan(args: argparse.Namespace) -> tuple[str, ScanQuality | None]:
    from client.session import connect

    async with connect(await chosen_node(args), token=args.token) as session:
        scan = await sweep_once(session, silent=args.json)
        return scan, await session.quality(scan)


async def sweep_once(session: Session, *, silent: bool) -> str:
    """Start a sweep when the scanner is ready, follow it, return the scan's id. Raises ScannerFault when it fails."""
    import asyncio
    import time

    from tqdm import tqdm

    from protocol.errors import ScannerFault

    published = session.published()
    await _ready(session)
    number = (await session.start_sweep())["sweep"]
    cut, until_s = "", 0.0
    with tqdm(total=100, unit="%", desc="sweeping", leave=False, disable=True if silent else None) as bar:
        while True:
            await asyncio.sleep(POLL_S)
            status = await session.scanner()
            bar.update(round(100 * status["progress"]) - bar.n)
            if status["sweeps"] >= number:
                return await anext(scan async for scan in published if scan.sweep == number)
            match status["phase"]:
                case "sweeping":
                    cut = ""
                case "connecting" if status["why"] and not cut:
                    cut, until_s = status["why"], time.monotonic() + AWAY_S
                    bar.write(f"foveascan: {printable(cut)}: waiting for the scanner to come back", sys.stderr)
                case "ready" if cut and not status["why"]:
                    until_s = min(until_s, time.monotonic() + BACK_S)
                case phase if phase != "connecting" and status["why"]:
                    raise ScannerFault(status["why"])
            if cut and time.monotonic() > until_s:
                raise ScannerFault(cut)


async def _ready(session: Session) -> None:
    """Wait until the scanner is connected. Raises ScannerFault when there is none, or it does not come."""
    import asyncio

    from protocol.errors import ScannerFault

    for _ in range(round(10 / POLL_S)):
        status = await session.scanner()
        if status["phase"] == "no scanner":
            raise ScannerFault("this node has no scanner: start it with --scanner ADDRESS")
        if status["phase"] == "ready":
            return
        await asyncio.sleep(POLL_S)
    raise ScannerFault(status["why"] or "the scanner does not answer: is it connected and on?")
