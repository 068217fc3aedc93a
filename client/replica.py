"""One opened scan kept in step with the node: what comes next, and whether both ends agree. No I/O.

Refinements of an opening (an epoch) are numbered from 0 and applied in that order. One that skips a number, or that was
planned over other holdings than ours, is not applied: we state what we hold and ignore what comes until the node goes
on from there, at the number we named.
"""

from __future__ import annotations

from client.classic_model import ClassicModel
from client.errors import HoldingsDiffer
from client.model import Applied, Model
from protocol.errors import RemoteWireError
from protocol.messages import Ack, Opened, State, Updated
from protocol.refinement import Refinement

STATEMENTS_MAX = 3
APPLY_MS_MAX = 1e6


class Replica:
    """A scan's model and our place in the node's refinements of it.

    epoch, request : of the opening.    next_seq : the refinement we wait for; all before it are applied.
    """

    def __init__(self, opened: Opened) -> None:
        self.model = ClassicModel(opened.scan) if opened.scan.profile == "classic" else Model(opened.scan)
        self.epoch = opened.epoch
        self.request = opened.request
        self.next_seq = 0
        self._apply_s = 0.0
        self._stated = False
        self._statements = 0

    def apply(self, refinement: Refinement) -> Applied | None:
        """Take in a refinement; None when it does not fit what we hold, and `object` is due.

        Raises RemoteWireError for one that is void, repeated or makes no sense.
        """
        if refinement.epoch != self.epoch or refinement.seq < self.next_seq:
            place = f"refinement {refinement.seq} of epoch {refinement.epoch}"
            raise RemoteWireError(f"{place} when {self.next_seq} of epoch {self.epoch} is next")
        if refinement.seq > self.next_seq:
            return None
        try:
            applied = self.model.apply(refinement)
        except HoldingsDiffer:
            return None
        self.next_seq += 1
        self._apply_s += applied.apply_s
        self._stated, self._statements = False, 0
        return applied

    def missing(self, updated: Updated) -> int:
        """How many refinements the node sent that we could not apply."""
        if updated.next_seq < self.next_seq:
            raise RemoteWireError(f"{updated.next_seq} refinements announced when {self.next_seq} had arrived")
        return updated.next_seq - self.next_seq

    def acknowledge(self) -> Ack:
        """What to say when everything sent so far is applied."""
        apply_ms, self._apply_s = 1000 * self._apply_s, 0.0
        return Ack(self.epoch, self.next_seq, self.model.digest(), min(apply_ms, APPLY_MS_MAX))

    def object(self) -> State | None:
        """What to say to a refinement that does not fit; None when we said it and the node has not gone on yet."""
        return None if self._stated else self.state()

    def state(self) -> State:
        """What we hold. Raises RemoteWireError when saying so again and again brings no agreement."""
        if self._statements == STATEMENTS_MAX:
            raise RemoteWireError(f"no agreement on what we hold after {STATEMENTS_MAX} statements")
        self._stated = True
        self._statements += 1
        return State(self.epoch, self.next_seq, self.model.state())
