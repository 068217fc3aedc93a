"""Whether an announced node is heard, by who looks for it from the same machine."""

from __future__ import annotations

import asyncio
import threading
import uuid
from contextlib import AsyncExitStack

import pytest

from node import advertise
from node.advertise import Advertisement, is_heard

HOST = "127.0.0.1"


def unique() -> str:
    """Other tests may announce nodes at the same time."""
    return f"test-{uuid.uuid4().hex[:12]}"


async def test_one_of_several_nodes_is_heard_and_nothing_listens_any_longer(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(advertise, "HEARD_S", 60.0)  # of a slow machine
    ids = [unique() for _ in range(3)]
    async with AsyncExitStack() as stack:
        for port, node_id in enumerate(ids, 7345):
            await stack.enter_async_context(Advertisement(node_id, node_id, HOST, port))
        for node_id in ids:
            assert await asyncio.to_thread(is_heard, HOST, node_id)
            assert not [thread.name for thread in threading.enumerate() if "ServiceBrowser" in thread.name]


async def test_nodes_of_one_name_that_come_up_at_once_are_all_heard(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(advertise, "HEARD_S", 60.0)
    name, ids = f"{'ward ' * 20}{unique()}", [uuid.uuid4().hex[:16] for _ in range(2)]
    announced = [Advertisement(name, node_id, HOST, port) for port, node_id in enumerate(ids, 7345)]
    await asyncio.gather(*(one.__aenter__() for one in announced))
    try:
        assert all([await asyncio.to_thread(is_heard, HOST, node_id) for node_id in ids])
    finally:
        await asyncio.gather(*(one.__aexit__(None, None, None) for one in announced))


def test_a_node_that_is_not_announced_is_not_heard(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(advertise, "HEARD_S", 0.2)
    assert not is_heard(HOST, unique())
    assert is_heard(HOST, None)
