"""The subcommand `calibrate`: find where the scanner's axis is, by a sweep of a round body."""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING, TypeVar

from client.arguments import add_node, between, chosen_node
from client.scan_command import record_of, sweep_once
from protocol.errors import UsageError
from protocol.printable import printable

if TYPE_CHECKING:
    from protocol.quality import FoundAxis

Result = TypeVar("Result")
WHAT = """Stand a round, upright, matt body of known diameter on the table, its middle about half its radius off the
table's, high enough to fill most of the view, and nothing else beside it. The node sweeps it, finds where the table's
axis really is, and corrects later sweeps of this scanner for that. A sweep that does not tell it well is refused, and
what was known before stays."""


def add_subcommands(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Offer `calibrate`."""
    calibrate = subparsers.add_parser(
        "calibrate", help="find where the scanner's axis is, by a sweep of a round body", description=WHAT
    )
    what = calibrate.add_mutually_exclusive_group(required=True)
    what.add_argument("--diameter", type=between(1, 2000), metavar="MM", help="of the body, by a calliper")
    what.add_argument("--list", action="store_true", help="say what is known of scanners' axes")
    what.add_argument("--forget", metavar="SERIAL", help="correct the sweeps of that scanner no longer")
    calibrate.add_argument("--scan", metavar="ID", help="with --diameter: take this sweep of the body, turn no table")
    add_node(calibrate)
    calibrate.set_defaults(run=run_calibrate)


def run_calibrate(args: argparse.Namespace) -> int:
    """Print the axis that was found, or those that are known."""
    import asyncio

    from client.axis import forget_axis, known_axes

    if args.scan is not None and args.diameter is None:
        raise UsageError("--scan: goes with --diameter; the other two look at no scan")
    if args.forget is not None and not args.forget.strip():
        raise UsageError("--forget: which scanner? --list says the serial numbers")
    if args.list:
        axes = asyncio.run(_at_node(args, known_axes))
        for known in axes:
            print(json.dumps(record_of(known)) if args.json else _in_words(known), flush=True)
        if not axes and not args.json:
            print("no scanner's axis is known: sweeps are as the scanner measures them", flush=True)
    elif args.forget is not None:
        asyncio.run(_at_node(args, forget_axis, args.forget))
        said = {"forgotten": args.forget}
        print(json.dumps(said) if args.json else f"axis of {printable(args.forget)} forgotten", flush=True)
    else:
        found = asyncio.run(_calibrate(args))
        print(json.dumps(record_of(found)) if args.json else _in_words(found), flush=True)
        if not args.json:
            print(f"sweeps of {printable(found.scanner)} are corrected for that from now on", flush=True)
    return 0


async def _at_node(args: argparse.Namespace, do: Callable[..., Awaitable[Result]], *values: str) -> Result:
    return await do(await chosen_node(args), *values, token=args.token)


async def _calibrate(args: argparse.Namespace) -> FoundAxis:
    from client.axis import calibrate_axis
    from client.session import connect

    node, scan = await chosen_node(args), args.scan
    if scan is None:
        async with connect(node, token=args.token) as session:
            scan = await sweep_once(session, silent=args.json)
        if not args.json:
            print(f"scan {printable(scan)}", flush=True)
    return await calibrate_axis(node, scan, args.diameter, token=args.token)


def _in_words(found: FoundAxis) -> str:
    """What was found, for a person."""
    lean, side = math.degrees(found.lean_error_rad), math.degrees(found.side_error_rad)
    return (
        f"axis of {printable(found.scanner)}: {found.axis.in_words}\n"
        f"  known to {found.lateral_error_mm:.3f} mm, {found.radial_error_mm:.3f} mm, {lean:.3f} and {side:.3f} degrees"
        f" at a height of {found.axis.height_mm:.1f} mm\n"
        f"  from a body of {found.diameter_mm:g} mm, {found.off_centre_mm:.1f} mm off the axis: noise"
        f" {found.noise_mm:.3f} mm, unevenness {found.uneven_mm:.3f} mm, scan {printable(found.scan)}"
    )
