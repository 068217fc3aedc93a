"""The order of a stream, for both ends. All transitions live here; nothing here does I/O or knows what a scan is.

A Session turns what arrives into messages, refinements and live columns, and what is to be sent into text or bytes. It
refuses what the other end may not say now (RemoteWireError) and what we may not (LocalWireError). Joined to each other,
the two roles test each other.

    phase     node says                                        client says
    new       serverInfo -> greeted                            -
    greeted   refused, goodbye -> closed                       hello -> waiting
    waiting   welcome -> ready, refused, goodbye -> closed     -
    ready     opened, updated, resync, published, refused,     open, look, ack, state, cancel, watch,
              enveloped, refinements, goodbye -> closed,       envelope
              liveStarted, liveProgress, liveEnded, live columns
    closed    -                                                -
"""

from __future__ import annotations

from enum import Enum

from protocol import messages as m
from protocol.errors import LocalWireError, RemoteWireError, WireError
from protocol.live import LiveColumns, is_live
from protocol.refinement import Refinement


class Role(Enum):
    """Which end of a stream we are."""

    NODE = "node"
    CLIENT = "client"


class Phase(Enum):
    """How far the stream has come."""

    NEW = "new"
    GREETED = "greeted"
    WAITING = "waiting"
    READY = "ready"
    CLOSED = "closed"


Said = m.Message | Refinement | LiveColumns

_LIVE = (m.LiveStarted, m.LiveProgress, m.LiveEnded, LiveColumns)
_SERVING = (m.Opened, m.Updated, m.Resync, m.Published, m.Refused, m.Goodbye, m.Enveloped, Refinement, *_LIVE)
_ASKING = (m.Open, m.Look, m.Ack, m.State, m.Cancel, m.Envelope, m.Watch)
_MAY_SAY: dict[tuple[Role, Phase], tuple[type, ...]] = {
    (Role.NODE, Phase.NEW): (m.ServerInfo,),
    (Role.NODE, Phase.GREETED): (m.Refused, m.Goodbye),
    (Role.NODE, Phase.WAITING): (m.Welcome, m.Refused, m.Goodbye),
    (Role.NODE, Phase.READY): _SERVING,
    (Role.CLIENT, Phase.GREETED): (m.Hello,),
    (Role.CLIENT, Phase.READY): _ASKING,
}
_LEADS_TO: dict[type, Phase] = {
    m.ServerInfo: Phase.GREETED,
    m.Hello: Phase.WAITING,
    m.Welcome: Phase.READY,
    m.Goodbye: Phase.CLOSED,
}


class Session:
    """One end of one stream."""

    def __init__(self, role: Role) -> None:
        self.role = role
        self.phase = Phase.NEW

    def receive(self, data: str | bytes) -> Said:
        """What the other end said: text is a message, bytes are refinements or live columns. Raises RemoteWireError."""
        said = m.decode_message(data) if isinstance(data, str) else _from_bytes(data)
        other = Role.CLIENT if self.role is Role.NODE else Role.NODE
        self._advance(other, said, RemoteWireError)
        return said

    def send(self, said: Said) -> str | bytes:
        """What to put on the wire. Raises LocalWireError."""
        self._advance(self.role, said, LocalWireError)
        return said.to_bytes() if isinstance(said, Refinement | LiveColumns) else m.encode_message(said)

    def _advance(self, speaker: Role, said: Said, error: type[WireError]) -> None:
        if not isinstance(said, _MAY_SAY.get((speaker, self.phase), ())):
            raise error(f"a {speaker.value} may not say {type(said).__name__} in a {self.phase.value} stream")
        self.phase = _LEADS_TO.get(type(said), self.phase)


def _from_bytes(data: bytes) -> Refinement | LiveColumns:
    return LiveColumns.from_bytes(data) if is_live(data) else Refinement.from_bytes(data)
