"""What can go wrong between a client and a node, beyond a broken wire.

FoveascanError
├── NodeLost        no node there, or not any more
├── NodeNotTrusted  somebody answers who is not the node we mean
├── RequestRefused  the node understood, and said no
└── HoldingsDiffer  node and client disagree on what the client has; the session states it anew
"""

from protocol.errors import FoveascanError


class NodeLost(FoveascanError):
    """There is no node at that address, or the stream to it has ended."""


class NodeNotTrusted(FoveascanError):
    """Who answers there cannot show to be the node we mean; it was told nothing."""


class RequestRefused(FoveascanError):
    """The node understood a request and said no. code: "bad request", "not found", "not open", "forbidden" ..."""

    def __init__(self, code: str, message: str) -> None:
        super().__init__(f"the node refused ({code}): {message}" if message else f"the node refused: {code}")
        self.code = code
        self.message = message


class HoldingsDiffer(FoveascanError):
    """A refinement was planned over other holdings than ours."""
