"""Two halves of one job at the same time, where a thread is free for one of them."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor, Future
from contextlib import suppress
from typing import TypeVar

A = TypeVar("A")
B = TypeVar("B")


def both(pool: Executor | None, one: Callable[[], A], other: Callable[[], B]) -> tuple[A, B]:
    """What both return. `one` runs in a thread of the pool if one gets to it before the caller has done the other.

    So the caller may be a thread of that pool itself: it waits for nothing that has not begun. Raises what they raise.
    """
    begun: Future[A] | None = None
    if pool is not None:
        with suppress(RuntimeError):  # the pool is being shut down: what runs is ended by itself
            begun = pool.submit(one)
    try:
        second = other()
    except BaseException:
        if begun is not None:
            begun.cancel()
        raise
    return one() if begun is None or begun.cancel() else begun.result(), second
