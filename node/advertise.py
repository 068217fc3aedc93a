"""Announcing the node on the LAN by DNS-SD, so that clients find it untold. No word of patients or scans."""

from __future__ import annotations

import socket
import time
from collections.abc import Generator
from contextlib import closing, suppress
from ipaddress import ip_address
from queue import Empty, SimpleQueue
from types import TracebackType

from zeroconf import Error, IPVersion, ServiceBrowser, ServiceInfo, ServiceStateChange, Zeroconf
from zeroconf.asyncio import AsyncZeroconf

from protocol.messages import PROTOCOL

SERVICE = "_foveascan._tcp.local."
LABEL_MAX_BYTES = 63
ID_DIGITS = 8  # in an instance's label
HEARD_S = 3.0
ANSWER_S = 0.5  # then another announced node is asked


class Advertisement:
    """An announcement that stands as long as the block it is used in. fingerprint : of the certificate, if any."""

    def __init__(self, name: str, node_id: str, host: str, port: int, fingerprint: str = "") -> None:
        address = ip_address(socket.getaddrinfo(host, port)[0][4][0])
        self._interfaces = _interfaces(host)
        tls = {"tls": "1", "fp": fingerprint} if fingerprint else {"tls": "0"}
        properties = {"proto": PROTOCOL, "id": node_id, "name": name, "state": "ready", **tls}
        self._info = ServiceInfo(
            SERVICE, f"{_label(name, node_id)}.{SERVICE}", port=port, properties=properties,
            server=f"foveascan-{node_id}.local.",
            addresses=[address.packed] if not address.is_unspecified else _own_addresses(),
        )  # fmt: skip

    async def __aenter__(self) -> Advertisement:
        if self._interfaces:
            self._zeroconf = AsyncZeroconf(interfaces=self._interfaces, ip_version=IPVersion.V4Only)
        else:
            self._zeroconf = AsyncZeroconf()
        await self._zeroconf.async_register_service(self._info, allow_name_change=True)
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self._zeroconf.async_unregister_all_services()
        await self._zeroconf.async_close()


def _label(name: str, node_id: str) -> str:
    """What an instance is called, its own even where nodes of one name come up at once, as after a power cut: each of
    them would find the name free, and clients would see now one and now the other."""
    own = f" ({node_id[:ID_DIGITS]})"
    return name.encode()[: LABEL_MAX_BYTES - len(own)].decode(errors="ignore").replace(".", "-") + own


def is_heard(host: str, node_id: str | None) -> bool:
    """Whether a node that serves `host` with this id is announced; None: whether it could be. Blocks up to HEARD_S.

    Raises OSError where multicast DNS cannot be used at all.
    """
    interfaces = _interfaces(host)
    zeroconf = Zeroconf(interfaces=interfaces, ip_version=IPVersion.V4Only) if interfaces else Zeroconf()
    try:
        with zeroconf, closing(_announced(zeroconf)) as nodes:
            return node_id is None or any(node.decoded_properties.get("id") == node_id for node in nodes)
    except Error as error:
        raise OSError(f"{type(error).__name__}: {error}") from error


def _announced(zeroconf: Zeroconf) -> Generator[ServiceInfo]:
    """Every node that says who it is within HEARD_S. Asked here, not by the browser's thread: that one is not
    waited for by who closes zeroconf."""
    names: SimpleQueue[str] = SimpleQueue()

    def on_change(zeroconf: Zeroconf, service_type: str, name: str, state_change: ServiceStateChange) -> None:
        if state_change is not ServiceStateChange.Removed:
            names.put(name)

    until_s = time.monotonic() + HEARD_S
    with ServiceBrowser(zeroconf, SERVICE, handlers=[on_change]), suppress(Empty):
        while (left_s := until_s - time.monotonic()) > 0:
            name = names.get(timeout=left_s)
            info = zeroconf.get_service_info(SERVICE, name, timeout=round(1000 * min(left_s, ANSWER_S)))
            if info is None:
                names.put(name)
            else:
                yield info


def _interfaces(host: str) -> list[str] | None:
    """Where to announce what is served at `host`; None: everywhere."""
    address = ip_address(socket.getaddrinfo(host, None)[0][4][0])
    return [str(address)] if address.is_loopback else None


def _own_addresses() -> list[bytes]:
    """Addresses of this host that others may reach it by."""
    found = socket.getaddrinfo(socket.gethostname(), None, type=socket.SOCK_STREAM)
    return sorted({ip_address(entry[4][0]).packed for entry in found})
