"""The other end of the LAN: find a node, hold a model of its scan, look where detail is wanted."""

from client.discover import NodeAddress, discover
from client.errors import NodeLost, RequestRefused
from client.model import Model
from client.session import Session, connect
from client.update import Sent, Update

__all__ = ["Model", "NodeAddress", "NodeLost", "RequestRefused", "Sent", "Session", "Update", "connect", "discover"]
