"""Arguments that several subcommands take: which node, checked numbers."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from datetime import datetime
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from client.discovery import NodeAddress

TIMEOUT_MAX_S = 3600
BYTES_MAX = 1 << 40


def add_search(parser: argparse.ArgumentParser) -> None:
    """Offer --json and --timeout."""
    parser.add_argument("--json", action="store_true", help="print one JSON object a line")
    parser.add_argument("--timeout", type=seconds, default=3.0, metavar="S", help="seconds to search for nodes (3)")


def add_node(parser: argparse.ArgumentParser, *, token: bool = True) -> None:
    """Offer --node, --token where one is of use, and what `add_search` does."""
    add_search(parser)
    parser.add_argument("--node", metavar="URL", help="https://HOST:PORT of a node (the one that discovery finds)")
    if token:
        parser.add_argument("--token", help="instead of what `foveascan join` has kept")


def add_closing(parser: argparse._ActionsContainer, sweep: Callable[[str], object], what: str) -> None:
    """Offer what a cylinder needs to become a sphere. sweep, what : of which type other sweeps are named, and how."""
    parser.add_argument("--caps", action="store_true", help="of a sphere: make up lids over ends that are open")
    parser.add_argument("--centre-height", type=number, metavar="MM", help="of a sphere's centre, up the axis (chosen)")
    parser.add_argument(
        "--top", type=sweep, metavar=what, help="a sweep of the object tipped over its front, its top towards angle 0"
    )
    parser.add_argument("--bottom", type=sweep, metavar=what, help="the same over its back, its bottom there")
    parser.add_argument("--tip", type=between(0, 180), default=90.0, metavar="DEG", help="how far it was tipped (90)")


async def chosen_node(args: argparse.Namespace) -> NodeAddress | str:
    """What --node names, else the one node on this network. Raises NodeLost unless there is one."""
    if args.node:
        return str(args.node)
    from client.discovery import discover
    from client.errors import NodeLost

    nodes = await discover(args.timeout)
    if not nodes:
        raise no_node(args.timeout)
    if len(nodes) > 1:
        raise NodeLost(f"{len(nodes)} nodes answer; choose one: --node {' or '.join(node.url for node in nodes)}")
    return nodes[0]


def no_node(timeout_s: float) -> Exception:
    """Nobody answered in time, and the cure."""
    from client.errors import NodeLost

    return NodeLost(f"no node answered within {timeout_s:g} s; start one with `foveascan serve` or use --node")


def made(unix_s: float) -> str:
    """When, for a list: by here and now's clock; a node's may have been anywhere."""
    try:
        return datetime.fromtimestamp(unix_s).isoformat(" ", "minutes")
    except (OverflowError, ValueError, OSError):
        return "at no known time"


def number(text: str) -> float:
    """A finite number. Raises ArgumentTypeError, here and below."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"expected a number, got {text!r}")
    return value


def positive(text: str) -> float:
    """A number above 0."""
    value = number(text)
    if value <= 0:
        raise argparse.ArgumentTypeError(f"expected a number above 0, got {text}")
    return value


def between(low: float, high: float) -> Callable[[str], float]:
    """A number from low to high."""

    def bounded(text: str) -> float:
        value = number(text)
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"expected a number from {low:g} to {high:g}, got {text}")
        return value

    return bounded


def share(text: str) -> float:
    """A number above 0, at most 1."""
    value = number(text)
    if not 0 < value <= 1:
        raise argparse.ArgumentTypeError(f"expected a number above 0, at most 1, got {text}")
    return value


def byte_count(text: str) -> int:
    """A whole number of bytes, at most 2^40."""
    if not (text.isascii() and text.isdigit() and len(text) <= 13 and int(text) <= BYTES_MAX):
        raise argparse.ArgumentTypeError(f"expected a whole number of bytes, at most {BYTES_MAX}, got {text!r}")
    return int(text)


def seconds(text: str) -> float:
    """A time to wait, above 0 and at most an hour. [s]"""
    value = positive(text)
    if value > TIMEOUT_MAX_S:
        raise argparse.ArgumentTypeError(f"expected at most {TIMEOUT_MAX_S} seconds, got {text}")
    return value
