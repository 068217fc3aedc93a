"""The subcommand `scans`: what a node's library holds."""

from __future__ import annotations

import argparse
import json
from datetime import datetime
from typing import Any

from client.arguments import add_node, chosen_node
from protocol.printable import printable


def add_subcommands(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Offer `scans`."""
    scans = subparsers.add_parser("scans", help="list a node's scans, newest first")
    add_node(scans)
    scans.set_defaults(run=run_scans)


def run_scans(args: argparse.Namespace) -> int:
    """Print every scan's id, when it was made, its size and its name."""
    import asyncio

    scans = asyncio.run(_scans(args))
    for scan in scans:
        print(json.dumps(scan) if args.json else _line(scan))
    if not scans and not args.json:
        print("no scans")
    return 0


async def _scans(args: argparse.Namespace) -> list[dict[str, Any]]:
    from client.login import logged_in
    from client.rest import ask

    async with logged_in(await chosen_node(args), args.token) as (url, http):
        return _checked(await ask(http, "GET", f"{url}/v1/scans"), url)


def _checked(said: Any, url: str) -> list[dict[str, Any]]:
    """A list of scans as a node says it. Raises RemoteWireError for anything else."""
    from protocol.errors import RemoteWireError

    if not isinstance(said, list) or not all(isinstance(scan, dict) and _is_scan(scan) for scan in said):
        raise RemoteWireError(f"{url} says something else than its scans: update the older of the two")
    return said


def _is_scan(scan: dict[str, Any]) -> bool:
    sides = (scan.get(side) for side in ("width", "height", "textureWidth", "textureHeight"))
    words = scan.get("id"), scan.get("name")
    return (
        all(isinstance(side, int) for side in sides)
        and all(isinstance(word, str) for word in words)
        and isinstance(scan.get("created"), int | float)
    )


def _line(scan: dict[str, Any]) -> str:
    shape = f"{scan['width']} x {scan['height']} + {scan['textureWidth']} x {scan['textureHeight']}"
    if scan.get("geometry", "cylinder") != "cylinder":
        shape += f" {printable(str(scan['geometry']))}"
    return f"{printable(scan['id'])}  {_made(scan['created'])}  {shape}  {printable(scan['name'])}".rstrip()


def _made(unix_s: float) -> str:
    """Here and now's clock; a node's may have been anywhere."""
    try:
        return datetime.fromtimestamp(unix_s).isoformat(" ", "minutes")
    except (OverflowError, ValueError, OSError):
        return "at no known time"
