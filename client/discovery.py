"""Nodes on this network, by DNS-SD: who they are and where they listen."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass

from yarl import URL
from zeroconf import IPVersion, ServiceStateChange, Zeroconf
from zeroconf.asyncio import AsyncServiceBrowser, AsyncServiceInfo, AsyncZeroconf

from client.errors import NodeLost

SERVICE = "_foveascan._tcp.local."
SETTLE_S = 0.3


@dataclass(frozen=True, slots=True)
class NodeAddress:
    """Where a node listens, and what it says of itself: stable id, readable name, state, whether it speaks TLS.

    fingerprint : SHA-256 of its certificate, hex, as announced. Anybody can announce anything: it proves nothing.
    """

    name: str
    host: str
    port: int
    id: str
    state: str
    tls: bool
    fingerprint: str = ""

    @property
    def url(self) -> str:
        """Its address as `connect` takes it."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{'https' if self.tls else 'http'}://{host}:{self.port}"


def located(node: NodeAddress | str) -> tuple[str, URL]:
    """A node's URL as it is kept and shown, and its parts; given by what `discover` found or by its URL.

    Raises NodeLost for what is no URL of a node.
    """
    url = node.url if isinstance(node, NodeAddress) else node.rstrip("/")
    try:
        parts = URL(url)
        if parts.scheme in ("http", "https") and parts.host:
            return url, parts
    except (ValueError, IndexError):  # IndexError: aio-libs/yarl#1822
        pass
    raise NodeLost(f"{url!r} is no address of a node; use https://HOST:PORT")


async def discover(timeout_s: float = 3, name: str | None = None, *, settle_s: float = SETTLE_S) -> list[NodeAddress]:
    """Nodes that answer, by name.

    name : only nodes of this name or id; the first one ends the search.
    Returns settle_s after the first node is found (others answer within about that time), else after timeout_s,
    then perhaps empty. Raises NodeLost when this machine has no network to ask on.
    """
    search = _Search(name)
    try:
        zeroconf = AsyncZeroconf()
    except OSError as error:
        raise NodeLost(f"cannot search the network ({error}); name the node by its URL") from error
    async with zeroconf:
        browser = AsyncServiceBrowser(zeroconf.zeroconf, SERVICE, handlers=[search.on_change])
        try:
            async with asyncio.timeout(timeout_s):
                await search.any_found.wait()
                await asyncio.sleep(0 if name else settle_s)
        except TimeoutError:
            pass  # what has answered by then is the result
        finally:
            await browser.async_cancel()
            await search.end()
    return sorted(search.found.values(), key=lambda node: (node.name, node.id))


class _Search:
    """Resolves the services a browser sees into addresses, each as a task of its own."""

    def __init__(self, name: str | None) -> None:
        self.found: dict[str, NodeAddress] = {}
        self.any_found = asyncio.Event()
        self._name = name
        self._tasks: dict[str, asyncio.Task[None]] = {}

    def on_change(self, zeroconf: Zeroconf, service_type: str, name: str, state_change: ServiceStateChange) -> None:
        """The browser's call, in the event loop."""
        if (task := self._tasks.pop(name, None)) is not None:
            task.cancel()
        if state_change is ServiceStateChange.Removed:
            self.found.pop(name, None)
        else:
            self._tasks[name] = asyncio.create_task(self._resolve(zeroconf, name))

    async def end(self) -> None:
        """Stop resolving."""
        for task in self._tasks.values():
            task.cancel()
        await asyncio.gather(*self._tasks.values(), return_exceptions=True)

    async def _resolve(self, zeroconf: Zeroconf, name: str) -> None:
        info = AsyncServiceInfo(SERVICE, name)
        while not await info.async_request(zeroconf, timeout=1000):
            pass  # an announced node that is slow to answer: the search's own timeout bounds this
        node = _address(info)
        if node is not None and self._name in (None, node.name, node.id):
            self.found[name] = node
            self.any_found.set()


def _address(info: AsyncServiceInfo) -> NodeAddress | None:
    """What a service record says, None when it gives no address."""
    hosts = info.parsed_scoped_addresses(IPVersion.V4Only) or info.parsed_scoped_addresses(IPVersion.All)
    if not hosts or not info.port:
        return None
    text = {_printable(key): _printable(value or b"") for key, value in info.properties.items()}
    name = text.get("name") or _printable(info.get_name().encode())
    return NodeAddress(
        name, hosts[0], info.port, text.get("id", ""), text.get("state", ""), text.get("tls") == "1",
        text.get("fp", ""),
    )  # fmt: skip


def _printable(raw: bytes) -> str:
    """Text from anyone on the network, fit for a terminal."""
    return "".join(c if c.isprintable() else "?" for c in raw.decode(errors="replace"))
