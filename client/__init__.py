"""The other end of the LAN: find a node, hold a model of its scan, look where detail is wanted.

    nodes = await discover(timeout_s=3)
    async with connect(nodes[0]) as session:
        model = await session.open("latest")
        update = await session.look(0.5, 0.5)
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from client.discovery import NodeAddress, discover
    from client.errors import NodeLost, NodeNotTrusted, RequestRefused
    from client.model import Model
    from client.pairing import pair
    from client.session import Session, connect
    from client.update import Sent, Update

__all__ = [
    "Model", "NodeAddress", "NodeLost", "NodeNotTrusted", "RequestRefused", "Sent", "Session", "Update", "connect",
    "discover", "pair",
]  # fmt: skip

_HOMES = {
    "NodeAddress": "client.discovery",
    "discover": "client.discovery",
    "NodeLost": "client.errors",
    "NodeNotTrusted": "client.errors",
    "RequestRefused": "client.errors",
    "Model": "client.model",
    "pair": "client.pairing",
    "Session": "client.session",
    "connect": "client.session",
    "Sent": "client.update",
    "Update": "client.update",
}


def __getattr__(name: str) -> Any:
    """Load a name when it is first asked for: the command line imports this package just to show its help."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)
