"""The subcommand `derive`: have a node make a sphere of a cylinder it has, or the other way round."""

from __future__ import annotations

import argparse
import json
from typing import TYPE_CHECKING

from client.arguments import add_closing, add_node, chosen_node
from protocol.printable import printable

if TYPE_CHECKING:
    from client.derive import Derived


def add_subcommands(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Offer `derive`."""
    derive = subparsers.add_parser("derive", help="have a node keep a scan in another geometry, as a scan of its own")
    derive.add_argument("--scan", default="latest", metavar="ID", help="which scan: its id, or six digits (latest)")
    derive.add_argument(
        "--geometry", choices=("cylinder", "sphere"), default="sphere", help="what to make of it (sphere)"
    )
    add_closing(derive, str, "ID")
    add_node(derive)
    derive.set_defaults(run=run_derive)


def run_derive(args: argparse.Namespace) -> int:
    """Print the new scan's id and how it was made."""
    import asyncio

    made = asyncio.run(_derive(args))
    record = {"scan": made.scan, "geometry": made.geometry, "note": made.note}
    lines = f"scan {printable(made.scan)}\n{printable(made.note)}"
    print(json.dumps(record) if args.json else lines, flush=True)
    return 0


async def _derive(args: argparse.Namespace) -> Derived:
    from client.derive import derive_scan

    return await derive_scan(
        await chosen_node(args), args.scan, args.geometry,
        caps=args.caps, centre_height_mm=args.centre_height, top=args.top, bottom=args.bottom, tip_deg=args.tip,
        token=args.token,
    )  # fmt: skip
