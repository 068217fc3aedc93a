"""What a browser's processes and the node spend of the processor, and what memory they have to themselves."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from pathlib import Path

from playwright.async_api import CDPSession

Spent = dict[str, float]  # [ms] of each of KINDS
KINDS = {"renderer": "page", "GPU": "graphics"}
OTHERS = "rest of the browser"


class Processes:
    """The processes of one browser and of the node it looks at. whole : the browser's own session."""

    def __init__(self, whole: CDPSession, node_pid: int) -> None:
        self._whole, self._node_pid = whole, node_pid

    async def all(self) -> list[tuple[str, int]]:
        """Kind and id of each process of the browser."""
        told = (await self._whole.send("SystemInfo.getProcessInfo"))["processInfo"]
        return [(one["type"], one["id"]) for one in told]

    @asynccontextmanager
    async def spending(self) -> AsyncIterator[Spent]:
        """What is spent while the block runs; filled in at its end. A process that ends meanwhile is not counted."""
        spent: Spent = {}
        before = {pid: spent_ms(pid) for _, pid in await self._counted()}
        yield spent
        spent.update({kind: 0.0 for kind in (*KINDS.values(), OTHERS, "node")})
        for kind, pid in await self._counted():
            spent[kind] += spent_ms(pid) - before.get(pid, 0.0)

    async def _counted(self) -> list[tuple[str, int]]:
        return [*((KINDS.get(kind, OTHERS), pid) for kind, pid in await self.all()), ("node", self._node_pid)]

    async def held_bytes(self) -> dict[str, int]:
        """Anonymous memory of the largest process of each kind."""
        running = await self.all()
        return {
            f"{kind} process": max((private_bytes(pid) for its, pid in running if its == type_), default=0)
            for type_, kind in KINDS.items()
        }


def spent_ms(pid: int) -> float:
    """Processor time of all threads of a process that still run; 0 once it has ended."""
    total_ns = 0
    with suppress(OSError):
        for thread in Path(f"/proc/{pid}/task").iterdir():
            with suppress(OSError):
                total_ns += int((thread / "schedstat").read_text().split()[0])
    return total_ns / 1e6


def private_bytes(pid: int) -> int:
    """Anonymous memory of a process."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return 1024 * next(int(line.split()[1]) for line in lines if line.startswith("RssAnon"))
