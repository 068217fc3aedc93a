"""The subcommand `join`: pair with a node, once, by the code that `foveascan pair` printed there."""

from __future__ import annotations

import argparse
import json
from typing import TYPE_CHECKING

from client.arguments import add_node, chosen_node

if TYPE_CHECKING:
    from client.credentials import Credential


def add_subcommands(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Offer `join`."""
    join = subparsers.add_parser("join", help="pair with a node by the code that was printed there")
    join.add_argument("code", help="ABCD-EFGH-IJKL-MNOP, as `foveascan pair` prints it on the node's machine")
    add_node(join, token=False)
    join.set_defaults(run=run_join)


def run_join(args: argparse.Namespace) -> int:
    """Pair, and say as whom."""
    import asyncio

    credential = asyncio.run(_join(args))
    said = {"node": credential.node, "url": credential.url, "name": credential.name, "role": credential.role}
    line = f"paired with {credential.url} as {credential.name}, role {credential.role}"
    print(json.dumps(said) if args.json else line, flush=True)
    return 0


async def _join(args: argparse.Namespace) -> Credential:
    from client.pairing import pair

    return await pair(await chosen_node(args), args.code)
