"""Headless client: `discover`, `join`, `calibrate`, `scan`, `scans`, `sweeps`, `export`, `import`, `derive`, `look`."""

from __future__ import annotations

import argparse
import json
from typing import TYPE_CHECKING, Any

from client import (
    calibrate_command,
    derive_command,
    exchange_command,
    join_command,
    scan_command,
    scans_command,
    sweeps_command,
)
from client.arguments import add_node, add_search, between, byte_count, chosen_node, no_node, number, share
from protocol.printable import printable

if TYPE_CHECKING:
    from tqdm import tqdm

    from client.discovery import NodeAddress
    from client.session import Session
    from client.update import Update

CENTRE = (0.5, 0.5)


def add_subcommands(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Offer `discover`, `join`, `calibrate`, `scan`, `scans`, `sweeps`, `export`, `import`, `derive` and `look`."""
    finder = subparsers.add_parser("discover", help="list the nodes on this network")
    add_search(finder)
    finder.add_argument("--name", help="stop at the node of this name or id")
    finder.set_defaults(run=run_discover)

    join_command.add_subcommands(subparsers)
    calibrate_command.add_subcommands(subparsers)
    scan_command.add_subcommands(subparsers)
    scans_command.add_subcommands(subparsers)
    sweeps_command.add_subcommands(subparsers)
    exchange_command.add_subcommands(subparsers)
    derive_command.add_subcommands(subparsers)

    looker = subparsers.add_parser("look", help="open a scan and get detail where you look")
    add_node(looker)
    looker.add_argument("--scan", default="latest", metavar="ID", help="which scan: its id, or six digits (latest)")
    looker.add_argument(
        "--at", type=_click, nargs="+", action="extend", metavar="U,V", help="where to look, each in [0, 1) (0.5,0.5)"
    )
    looker.add_argument("--window", type=share, default=0.05, metavar="SHARE", help="share of the area, 0..1 (0.05)")
    looker.add_argument("--texture-db", type=between(10, 100), default=40, metavar="DB", help="PSNR to stop at (40)")
    looker.add_argument("--range-mm", type=between(0, 1000), default=0.1, metavar="MM", help="error to stop at (0.1)")
    looker.add_argument("--max-wait", type=between(0.05, 30), metavar="S", help="seconds a look may take, 0.05..30")
    looker.add_argument("--max-bytes", type=byte_count, metavar="N", help="bytes a look may take")
    looker.add_argument(
        "--profile", choices=["default", "classic"], default="default", help="default, or the paper's letter"
    )
    looker.add_argument("-o", "--output", metavar="FILE", help="write the model; the suffix is the format (.glb ...)")
    looker.set_defaults(run=run_look)


def run_discover(args: argparse.Namespace) -> int:
    """Print the nodes that answer; status 1 when none does."""
    import asyncio

    from client.discovery import discover

    with _progress(args, 1, "searching") as bar:
        nodes = asyncio.run(discover(args.timeout, args.name))
        bar.update()
    for node in nodes:
        _print(args, _node_record(node), f"{node.url}  {printable(node.name)}  {node.state}")
    if not nodes:
        raise no_node(args.timeout)
    return 0


def run_look(args: argparse.Namespace) -> int:
    """Open a scan, look at each place, print what came of it."""
    import asyncio

    from client.export import check_target

    if args.output:
        check_target(args.output)
    asyncio.run(_look(args))
    return 0


async def _look(args: argparse.Namespace) -> None:
    from client.session import connect

    clicks = args.at or [CENTRE]
    with _progress(args, 1 + len(clicks), "looking") as bar:
        async with connect(await chosen_node(args), token=args.token) as session:
            model = await session.open(args.scan, profile=args.profile)
            bar.update()
            s = model.info
            shape = [s.height, s.width], [s.texture_height, s.texture_width]
            first_view_bytes = session.stats.bytes_received
            record = {"scan": s.id, "range": shape[0], "texture": shape[1], "first_view_bytes": first_view_bytes}
            _print(args, record, f"scan {printable(s.id)}: {s.width} x {s.height}, first view {first_view_bytes} bytes")
            for u, v in clicks:
                update = await _look_at(session, args, u, v)
                bar.update()
                _print(args, _update_record(u, v, update), _update_line(u, v, update, args.range_mm))
    if args.output:
        model.export(args.output)


async def _look_at(session: Session, args: argparse.Namespace, u: float, v: float) -> Update:
    return await session.look(
        u,
        v,
        window=args.window,
        texture_db=args.texture_db,
        range_mm=args.range_mm,
        max_wait_s=args.max_wait,
        max_bytes=args.max_bytes,
    )


def _node_record(node: NodeAddress) -> dict[str, Any]:
    return {
        "name": node.name, "id": node.id, "state": node.state, "url": node.url, "tls": node.tls,
        "fingerprint": node.fingerprint,
    }  # fmt: skip


def _update_record(u: float, v: float, update: Update) -> dict[str, Any]:
    return {
        "u": u,
        "v": v,
        "reason": update.reason,
        "bytes": update.bytes_received,
        "samples": update.samples,
        "elapsed_s": round(update.elapsed_s, 4),
        "error_max_mm": update.error_max_mm,
        "texture_db": update.texture_db,
    }


def _update_line(u: float, v: float, update: Update, range_mm: float) -> str:
    reached = [f"{update.bytes_received} bytes", f"{update.elapsed_s:.3f} s"]
    if update.error_max_mm is not None:
        reached.append(_range_reached(update, range_mm))
    if update.texture_db is not None:
        reached.append(f"texture {update.texture_db:.1f} dB")
    return f"({u:g}, {v:g}): {update.reason}, {', '.join(reached)}"


def _range_reached(update: Update, range_mm: float) -> str:
    """A look is complete when 99% of the window is within what was asked; the largest error is of all that it touched.

    Said apart, so that one outlier at an edge is not taken for a promise that was not kept.
    """
    worst = f"{update.error_max_mm:.3g} mm"
    if update.reason != "complete" or update.error_max_mm is None or update.error_max_mm <= range_mm:
        return f"range within {worst}"
    return f"range 99% within {range_mm:g} mm, all within {worst}"


def _print(args: argparse.Namespace, record: dict[str, Any], line: str) -> None:
    from tqdm import tqdm

    tqdm.write(json.dumps(record) if args.json else line)


def _progress(args: argparse.Namespace, total: int, what: str) -> tqdm[Any]:
    """A bar on standard error where that is a terminal."""
    from tqdm import tqdm

    return tqdm(total=total, desc=what, leave=False, disable=True if args.json else None)


def _click(text: str) -> tuple[float, float]:
    u, separator, v = text.partition(",")
    if not separator:
        raise argparse.ArgumentTypeError(f"expected U,V, got {text!r}")
    click = number(u), number(v)
    if not all(0 <= coordinate < 1 for coordinate in click):
        raise argparse.ArgumentTypeError(f"u and v must be in [0, 1), got {text}")
    return click
