"""A parser, and how many inputs it is given: the first drawn by hypothesis, more of them by a quicker generator."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass

from hypothesis import HealthCheck, Phase, given, seed, settings

from protocol.errors import FoveascanError
from tests.fuzz.mutation import mutant, mutants

DRAWN = 2000


@dataclass(frozen=True)
class Target:
    """A parser. seeds : valid inputs.  parse : takes bytes, raises nothing but `may`."""

    name: str
    seeds: tuple[bytes, ...]
    parse: Callable[[bytes], object]
    may: tuple[type[Exception], ...] = (FoveascanError,)


class Found(Exception):
    """A parser raised what it may not, which is the cause."""


def fuzz(target: Target, count: int, first: int = 0, drawn: int = DRAWN) -> None:
    """So many inputs for a parser, the first of them drawn by hypothesis, which finds the smallest that fails.

    The others come from a generator a hundred times as quick. Raises what the parser raised that it may not, or Found
    with the input.
    """
    _drawn(target, min(count, drawn), first)
    draw = random.Random(first)
    for _ in range(count - drawn):
        data = mutant(target.seeds, draw)
        try:
            target.parse(data)
        except target.may:
            pass
        except Exception as problem:
            raise Found(f"{target.name}: {type(problem).__name__}: {problem}, of {data!r}") from problem


def _drawn(target: Target, count: int, first: int) -> None:
    @seed(first)
    @settings(
        max_examples=count, deadline=None, database=None, phases=(Phase.generate, Phase.shrink), print_blob=True,
        suppress_health_check=list(HealthCheck),
    )  # fmt: skip
    @given(mutants(target.seeds))
    def one(data: bytes) -> None:
        try:
            target.parse(data)
        except target.may:
            pass

    one()
