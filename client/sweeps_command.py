"""The subcommand `sweeps`: what a node has kept of sweeps that were cut; going on with one, fetching, deleting it."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING

from client.arguments import add_node, chosen_node, made
from client.scan_command import resume, say_scan
from protocol.errors import UsageError
from protocol.printable import printable

if TYPE_CHECKING:
    from client.session import InterruptedSweep, Session

WHAT = """A sweep that was cut is kept with all that came of it, and is no scan. To go on with one, the object must
stand as it stood: where the same scanner still has what is missing, it sends that, else it turns again for it."""
DIGITS_MIN = 6


def add_subcommands(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Offer `sweeps`."""
    sweeps = subparsers.add_parser(
        "sweeps", help="sweeps that were cut: list them, go on with one, fetch or delete it", description=WHAT
    )
    what = sweeps.add_mutually_exclusive_group()
    what.add_argument("--resume", metavar="ID", help="go on with one: its id, six digits, or latest")
    what.add_argument("--fetch", metavar="ID", help="write what there is of one to a file: see -o")
    what.add_argument("--delete", metavar="ID", help="delete one for good: its whole id")
    sweeps.add_argument("-o", "--output", type=Path, metavar="FILE", help="with --fetch: an .npz, not a scan's")
    add_node(sweeps)
    sweeps.set_defaults(run=run_sweeps)


def run_sweeps(args: argparse.Namespace) -> int:
    """Print the sweeps that were cut, or what became of the one named."""
    import asyncio

    if (args.output is None) != (args.fetch is None):
        raise UsageError("--fetch ID and -o FILE: the one goes with the other")
    if args.output is not None and args.output.suffix.lower() != ".npz":
        raise UsageError(f"{args.output}: what there is of a sweep is written as .npz")
    asyncio.run(_run(args))
    return 0


async def _run(args: argparse.Namespace) -> None:
    from client.session import connect
    from client.transfer import fetch_sweep

    node = await chosen_node(args)
    async with connect(node, token=args.token) as session:
        if args.resume is not None:
            await say_scan(session, await resume(session, await _named(session, args.resume), args.json), args.json)
        elif args.fetch is not None:
            sweep = await _named(session, args.fetch)
            size = await fetch_sweep(node, sweep, args.output, token=args.token)
            _say(args, {"file": str(args.output), "bytes": size}, f"{args.output}: {size} bytes")
        elif args.delete is not None:
            await session.delete_sweep(args.delete)
            _say(args, {"deleted": args.delete}, f"sweep {printable(args.delete)} deleted")
        else:
            await _list(args, session)


def _say(args: argparse.Namespace, record: dict[str, object], line: str) -> None:
    print(json.dumps(record) if args.json else line, flush=True)


async def _list(args: argparse.Namespace, session: Session) -> None:
    import msgspec

    sweeps = await session.sweeps()
    for sweep in reversed(sweeps):
        _say(args, msgspec.to_builtins(sweep), _line(sweep))
    if not sweeps and not args.json:
        print("no sweep was cut", flush=True)


def _line(sweep: InterruptedSweep) -> str:
    shape = f"{sweep.width} x {sweep.height} + {sweep.texture_width} x {sweep.texture_height}"
    return (
        f"{printable(sweep.id)}  {made(sweep.ended)}  {sweep.percent} % of {shape}"
        f"  {printable(sweep.scanner)}  {printable(sweep.why)}"
    )


async def _named(session: Session, given: str) -> str:
    """The id of the sweep that is meant. Raises UsageError unless there is one, and one only."""
    ids = [sweep.id for sweep in await session.sweeps()]
    if given == "latest":
        found = ids[-1:]
    else:
        found = [known for known in ids if known == given or (len(given) >= DIGITS_MIN and known.startswith(given))]
    if len(found) != 1:
        known = f"several begin with {given!r}" if found else f"no sweep {given!r} was cut"
        raise UsageError(f"{known}; `foveascan sweeps` lists their ids")
    return found[0]
