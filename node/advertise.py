"""Announcing the node on the LAN by DNS-SD, so that clients find it untold. No word of patients or scans."""

from __future__ import annotations

import socket
import threading
from ipaddress import ip_address
from types import TracebackType

from zeroconf import IPVersion, ServiceBrowser, ServiceInfo, ServiceStateChange, Zeroconf
from zeroconf.asyncio import AsyncZeroconf

from protocol.messages import PROTOCOL

SERVICE = "_foveascan._tcp.local."
NAME_MAX_BYTES = 63
HEARD_S = 3.0


class Advertisement:
    """An announcement that stands as long as the block it is used in. fingerprint : of the certificate, if any."""

    def __init__(self, name: str, node_id: str, host: str, port: int, fingerprint: str = "") -> None:
        address = ip_address(socket.getaddrinfo(host, port)[0][4][0])
        self._interfaces = _interfaces(host)
        tls = {"tls": "1", "fp": fingerprint} if fingerprint else {"tls": "0"}
        properties = {"proto": PROTOCOL, "id": node_id, "name": name, "state": "ready", **tls}
        label = name.encode()[:NAME_MAX_BYTES].decode(errors="ignore").replace(".", "-")
        self._info = ServiceInfo(
            SERVICE, f"{label}.{SERVICE}", port=port, properties=properties, server=f"foveascan-{node_id}.local.",
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


def is_heard(host: str, node_id: str | None) -> bool:
    """Whether a node that serves `host` with this id is announced; None: whether it could be. Blocks up to HEARD_S.

    Raises OSError where multicast DNS cannot be used at all.
    """
    interfaces = _interfaces(host)
    zeroconf = Zeroconf(interfaces=interfaces, ip_version=IPVersion.V4Only) if interfaces else Zeroconf()
    heard = threading.Event()

    def on_change(zeroconf: Zeroconf, service_type: str, name: str, state_change: ServiceStateChange) -> None:
        info = zeroconf.get_service_info(service_type, name)
        if info is not None and info.decoded_properties.get("id") == node_id:
            heard.set()

    with zeroconf:
        if node_id is None:
            return True
        ServiceBrowser(zeroconf, SERVICE, handlers=[on_change])
        return heard.wait(HEARD_S)


def _interfaces(host: str) -> list[str] | None:
    """Where to announce what is served at `host`; None: everywhere."""
    address = ip_address(socket.getaddrinfo(host, None)[0][4][0])
    return [str(address)] if address.is_loopback else None


def _own_addresses() -> list[bytes]:
    """Addresses of this host that others may reach it by."""
    found = socket.getaddrinfo(socket.gethostname(), None, type=socket.SOCK_STREAM)
    return sorted({ip_address(entry[4][0]).packed for entry in found})
