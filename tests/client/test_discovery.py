from __future__ import annotations

import asyncio
import socket
import time
import uuid
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import replace

import pytest
from zeroconf import ServiceInfo
from zeroconf.asyncio import AsyncZeroconf

from client.discovery import SERVICE, NodeAddress, discover


def unique() -> str:
    """Other tests may announce nodes at the same time."""
    return f"test-{uuid.uuid4().hex[:12]}"


@asynccontextmanager
async def announced(name: str, port: int = 7345, **properties: str) -> AsyncIterator[None]:
    """A node's record on loopback."""
    text = {"proto": "foveascan.v1", "name": name, "id": f"id-{name}", "state": "ready", "tls": "0", **properties}
    record = ServiceInfo(
        SERVICE,
        f"{name}.{SERVICE}",
        port=port,
        addresses=[socket.inet_aton("127.0.0.1")],
        properties=text,
        server=f"{name}.local.",
    )
    zeroconf = AsyncZeroconf(interfaces=["127.0.0.1"])
    async with zeroconf:
        await (await zeroconf.async_register_service(record, cooperating_responders=True))
        yield


async def test_an_announced_node_is_found_with_all_it_says() -> None:
    name = unique()
    async with announced(name, 8123, tls="1"):
        found = await discover(5, name)
    assert found == [NodeAddress(name, "127.0.0.1", 8123, f"id-{name}", "ready", True)]


async def test_a_node_is_found_by_its_id_too() -> None:
    name = unique()
    async with announced(name):
        assert [node.name for node in await discover(5, f"id-{name}")] == [name]


async def test_all_nodes_are_listed_by_name() -> None:
    names = sorted([unique(), unique()])
    async with announced(names[1]), announced(names[0]):
        found = [node.name for node in await discover(5, settle_s=2)]
    assert [name for name in found if name in names] == names


async def test_a_search_by_name_ends_with_the_node_it_asks_for() -> None:
    name = unique()
    async with announced(name):
        started = time.perf_counter()
        await discover(60, name)
        assert time.perf_counter() - started < 30


async def test_nobody_of_that_name_is_an_empty_list() -> None:
    async with announced(unique()):
        assert await discover(0.5, unique()) == []


async def test_a_node_that_took_its_record_back_is_not_found() -> None:
    name = unique()
    async with announced(name):
        pass
    assert await discover(0.5, name) == []


async def test_a_node_that_appears_during_the_search_is_found() -> None:
    name = unique()
    search = asyncio.create_task(discover(10, name))
    async with announced(name):
        assert [node.name for node in await search] == [name]


async def test_unprintable_text_from_the_network_is_not_passed_on() -> None:
    name = unique()
    async with announced(name, state="\x1b[2J\n"):
        (node,) = await discover(5, name)
    assert node.state == "?[2J?"


async def test_a_record_without_our_keys_still_names_a_node() -> None:
    name = unique()
    async with announced(name, state="", id="", proto=""):
        (node,) = await discover(5, name)
    assert (node.name, node.id, node.state, node.tls) == (name, "", "", False)


@pytest.mark.parametrize(
    ("host", "tls", "url"),
    [
        ("192.0.2.7", False, "http://192.0.2.7:80"),
        ("192.0.2.7", True, "https://192.0.2.7:80"),
        ("fe80::1%eth0", False, "http://[fe80::1%eth0]:80"),
    ],
)
def test_an_address_becomes_a_url(host: str, tls: bool, url: str) -> None:
    assert replace(NodeAddress("n", host, 80, "", "", False), tls=tls).url == url
