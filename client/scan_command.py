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

    from client.news import News
    from client.session import InterruptedSweep, Session
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

    asyncio.run(_scan(args))
    return 0


async def say_scan(session: Session, scan: str, as_json: bool) -> None:
    """Print the id of a scan that was swept, and what it is worth."""
    quality = await session.quality(scan)
    if as_json:
        print(json.dumps({"scan": scan, "quality": record_of(quality) if quality else None}), flush=True)
        return
    print(f"scan {printable(scan)}", flush=True)
    for line in _in_words(quality) if quality else ():
        print(line, flush=True)


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


async def _scan(args: argparse.Namespace) -> None:
    from client.session import connect

    async with connect(await chosen_node(args), token=args.token) as session:
        await say_scan(session, await sweep_once(session, silent=args.json), args.json)


async def sweep_once(session: Session, *, silent: bool) -> str:
    """Start a sweep when the scanner is ready, follow it, return the scan's id. Raises ScannerFault when it fails."""
    from protocol.errors import ScannerFault

    published = session.published()
    await _ready(session)
    before = await _interrupted(session)
    number = (await session.start_sweep())["sweep"]
    try:
        return await _followed(session, published, number, silent)
    except ScannerFault as fault:
        for sweep in reversed([*(await _interrupted(session)).values()]):
            if sweep.id not in before:
                kept = f"{sweep.percent} % of it is kept: foveascan sweeps --resume {printable(sweep.id)}"
                raise ScannerFault(f"{fault}; {kept}") from fault
        raise


async def resume(session: Session, sweep: str, silent: bool) -> str:
    """Go on with a sweep that was cut, when the scanner is ready; the scan's id. Raises ScannerFault when it fails."""
    published = session.published()
    await _ready(session)
    number = (await session.resume_sweep(sweep))["sweep"]
    return await _followed(session, published, number, silent)


async def _interrupted(session: Session) -> dict[str, InterruptedSweep]:
    """The sweeps that were cut, oldest first, by id; none where the node does not say."""
    from client.errors import NodeLost, RequestRefused
    from protocol.errors import RemoteWireError

    try:
        return {sweep.id: sweep for sweep in await session.sweeps()}
    except (NodeLost, RequestRefused, RemoteWireError):
        return {}


async def _followed(session: Session, published: News, number: int, silent: bool) -> str:
    """The id of the scan that a sweep becomes. Raises ScannerFault when it does not."""
    import asyncio
    import time

    from tqdm import tqdm

    from protocol.errors import ScannerFault

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
