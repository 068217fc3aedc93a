"""What came of one look: what it cost, what it reached, what it changed."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from client.model import Applied
from protocol.grid import IntArray
from protocol.lattice import Channel
from protocol.messages import Updated
from protocol.refinement import AnyParameters, Refinement

ChannelName = Literal["range", "texture"]


@dataclass(frozen=True, slots=True)
class Sent:
    """One refinement as it travelled.

    quality : range, quantum in steps; texture, 0..255, classic: the JPEG's Q.     codec : id on the wire.
    """

    channel: ChannelName
    parameters: AnyParameters
    quality: int
    codec: int
    samples: int
    payload_bytes: int

    @property
    def p(self) -> float:
        """Plateau spacing; classic: the first beside the fovea, of the wider axis. [source samples, sphere: rad]"""
        return self.parameters.spacing


@dataclass(frozen=True, slots=True, eq=False)
class Update:
    """The answer to one look.

    reason : "complete", "byte limit" or "superseded" (a newer look took over).
    bytes_received : of its WebSocket messages, our headers and the closing message included.
    payload_bytes : of coded values alone, without headers, parameters and void masks.      samples : values received.
    elapsed_s : from asking until the model held it.       apply_s : of which decoding and reconstruction.
    error_max_mm, texture_db : what the node says is reached in the window; None where it did not look.
    parameters : the refinements that travelled.
    changed : dense blocks overwritten, by "range" and "texture": flat indices in row order, (n,) int64, ascending.
    lost : refinements that could not be applied; the node has been told what we hold, ask again.
    encodes, node_ms : images the node coded for it, and the time it spent.
    """

    request: int
    reason: Literal["complete", "byte limit", "superseded"]
    bytes_received: int
    payload_bytes: int
    samples: int
    elapsed_s: float
    apply_s: float
    error_max_mm: float | None
    texture_db: float | None
    parameters: tuple[Sent, ...]
    changed: dict[ChannelName, IntArray]
    lost: int
    encodes: int
    node_ms: float


@dataclass(slots=True)
class Tally:
    """Counts what arrives for one look."""

    request: int
    started_s: float = field(default_factory=time.perf_counter)
    bytes_received: int = 0
    apply_s: float = 0.0
    sent: list[Sent] = field(default_factory=list)
    blocks: dict[Channel, list[IntArray]] = field(default_factory=lambda: {channel: [] for channel in Channel})

    def add(self, refinement: Refinement, applied: Applied) -> None:
        """Count one refinement that the model has taken."""
        assert refinement.parameters is not None
        name = channel_name(refinement.channel)
        payload_bytes = len(refinement.payload)
        self.sent.append(
            Sent(name, refinement.parameters, refinement.quality, refinement.codec, refinement.samples, payload_bytes)
        )
        self.blocks[refinement.channel].append(applied.blocks)
        self.apply_s += applied.apply_s

    def close(self, said: Updated, lost: int = 0) -> Update:
        """The update, with the node's closing message."""
        return Update(
            request=self.request,
            reason=said.reason,
            bytes_received=self.bytes_received,
            payload_bytes=sum(sent.payload_bytes for sent in self.sent),
            samples=sum(sent.samples for sent in self.sent),
            elapsed_s=time.perf_counter() - self.started_s,
            apply_s=self.apply_s,
            error_max_mm=said.error_max_mm,
            texture_db=said.texture_db,
            parameters=tuple(self.sent),
            changed={channel_name(channel): self._changed(channel) for channel in Channel},
            lost=lost,
            encodes=said.encodes,
            node_ms=said.node_ms,
        )

    def _changed(self, channel: Channel) -> IntArray:
        blocks = self.blocks[channel]
        return np.unique(np.concatenate(blocks)) if blocks else np.zeros(0, np.int64)


def channel_name(channel: Channel) -> ChannelName:
    """The channel's name in the public interface."""
    return "range" if channel is Channel.RANGE else "texture"
