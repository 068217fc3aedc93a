"""Subcommands run as `foveascan` runs them, against a node that follows a script."""

from __future__ import annotations

import argparse
import json
from typing import Any

from client import command
from tests.client.scripted_node import Line, greet


def parse(*arguments: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    command.add_subcommands(parser.add_subparsers(required=True))
    return parser.parse_args(arguments)


def run(*arguments: str) -> int:
    """A subcommand as `foveascan` runs it."""
    args = parse(*arguments)
    status: int = args.run(args)
    return status


def json_lines(text: str) -> list[dict[str, Any]]:
    return [json.loads(line) for line in text.splitlines()]


async def greet_and_wait(line: Line) -> None:
    """A node that has nothing to say."""
    await greet(line)
    await line.gone()
