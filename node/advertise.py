"""Announcing the node on the LAN by DNS-SD, so that clients find it untold. No word of patients or scans."""

from __future__ import annotations

import socket
from ipaddress import ip_address
from types import TracebackType

from zeroconf import IPVersion, ServiceInfo
from zeroconf.asyncio import AsyncZeroconf

from protocol.messages import PROTOCOL

SERVICE = "_foveascan._tcp.local."
NAME_MAX_BYTES = 63


class Advertisement:
    """An announcement that stands as long as the block it is used in."""

    def __init__(self, name: str, node_id: str, host: str, port: int, *, tls: bool = False) -> None:
        address = ip_address(socket.getaddrinfo(host, port)[0][4][0])
        self._interfaces = [str(address)] if address.is_loopback else None
        properties = {"proto": PROTOCOL, "id": node_id, "name": name, "state": "ready", "tls": str(int(tls))}
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


def _own_addresses() -> list[bytes]:
    """Addresses of this host that others may reach it by."""
    found = socket.getaddrinfo(socket.gethostname(), None, type=socket.SOCK_STREAM)
    return sorted({ip_address(entry[4][0]).packed for entry in found})
