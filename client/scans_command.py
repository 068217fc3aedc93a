"""The subcommand `scans`: what a node's library holds."""

from __future__ import annotations

import argparse
import json
from typing import TYPE_CHECKING, Any

from client.arguments import add_node, chosen_node, made
from protocol.printable import printable

if TYPE_CHECKING:
    from client.rest import ListedScan


def add_subcommands(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Offer `scans`."""
    scans = subparsers.add_parser("scans", help="list a node's scans, newest first")
    add_node(scans)
    scans.set_defaults(run=run_scans)


def run_scans(args: argparse.Namespace) -> int:
    """Print every scan's id, when it was made, its size and its name."""
    import asyncio

    from client.rest import ListedScan, checked

    said = asyncio.run(_scans(args))
    scans = checked(said, list[ListedScan], "the node lists its scans; update the older of the two")
    for record, scan in zip(said, scans, strict=True):
        print(json.dumps(record) if args.json else _line(scan))
    if not scans and not args.json:
        print("no scans")
    return 0


async def _scans(args: argparse.Namespace) -> Any:
    """The list as the node says it."""
    from client.login import logged_in
    from client.rest import ask

    async with logged_in(await chosen_node(args), args.token) as (url, http):
        return await ask(http, "GET", f"{url}/v1/scans")


def _line(scan: ListedScan) -> str:
    shape = f"{scan.width} x {scan.height} + {scan.texture_width} x {scan.texture_height}"
    if scan.geometry != "cylinder":
        shape += f" {printable(scan.geometry)}"
    return f"{printable(scan.id)}  {made(scan.created)}  {shape}  {printable(scan.name)}".rstrip()
