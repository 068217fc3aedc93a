"""What a node announces on its own account, for whoever cares to listen."""

from __future__ import annotations

import asyncio
from collections import deque

from protocol.errors import FoveascanError

WAITING_MAX = 256


class NewScan(str):
    """The id of a newly published scan, and how it came about.

    sweep : which of the node's finished sweeps it is, as session.scanner()["sweeps"] counts them; 0: of no sweep.
    made_from : ids of the scans that it was made of.
    """

    sweep: int
    made_from: tuple[str, ...]

    def __new__(cls, scan: str, sweep: int = 0, made_from: tuple[str, ...] = ()) -> NewScan:
        """As a node announces it."""
        new = super().__new__(cls, scan)
        new.sweep, new.made_from = sweep, made_from
        return new


class News:
    """Newly published scans, from its creation on: `async for scan in session.published()`.

    Ends with the session; raises what ended it, or FoveascanError when WAITING_MAX scans were left unread.
    """

    def __init__(self) -> None:
        self._waiting: deque[NewScan] = deque()
        self._changed = asyncio.Event()
        self._ended = False
        self._cause: Exception | None = None

    def tell(self, scan: NewScan) -> None:
        """A scan was published."""
        if self._ended:
            return
        if len(self._waiting) < WAITING_MAX:
            self._waiting.append(scan)
            self._changed.set()
        else:
            self.end(FoveascanError(f"{WAITING_MAX} published scans were left unread; ask the node for its list"))

    def end(self, cause: Exception | None) -> None:
        """Nothing more will come; cause None: the session was closed on purpose."""
        if not self._ended:
            self._ended, self._cause = True, cause
            self._changed.set()

    def __aiter__(self) -> News:
        return self

    async def __anext__(self) -> NewScan:
        while not self._waiting:
            if self._ended:
                raise self._cause or StopAsyncIteration
            self._changed.clear()
            await self._changed.wait()
        return self._waiting.popleft()
