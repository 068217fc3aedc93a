"""Planning one update of a classic session: mesh and texture of one fovea, the largest scale that fits the budget.

Distortion and JPEG quality are fixed, and one scale S serves both: the texture's, and S / N for the mesh, N texels to a
mesh column. The size of a JPEG does not follow its scale monotonically, so every candidate is encoded and weighed.

Source: Cheng, Basu, Pan 2003, Eq. (15), with REQUIREMENTS F-03, F-14.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import msgspec

from node.classic import ClassicCoded, ClassicState, code_classic_range, code_classic_texture
from node.classic_sphere import code_sphere, window_rings
from node.foveate import REPLY_BYTES, Reason
from node.library import Scan
from protocol.classic import ClassicParameters, single
from protocol.errors import LatticeError
from protocol.fovea import finest_scale, scale_from_sigma
from protocol.lattice import Channel, ChannelShape
from protocol.messages import ClassicLookParameters, ClassicRange, ClassicTexture, Look

SCALE_MIN = 0.1  # one sample is all that is left of a fovea
BISECTIONS = 8
FOVEAE_MAX = 65535
SHRINK, SHRINKS = 0.7, 16  # of the window of rings that take too many bytes


@dataclass(frozen=True, slots=True)
class ClassicUpdate:
    """A planned update; see node.foveate.Update. No error is measured: the paper stops at the budget."""

    coded: tuple[ClassicCoded, ...]
    state: ClassicState
    reason: Reason
    error_max_mm: None = None
    texture_db: None = None
    encodes: int = 0


def plan_classic(
    scan: Scan,
    state: ClassicState,
    look: Look,
    budget_bytes: int | None = None,
    superseded: Callable[[], bool] = lambda: False,
) -> ClassicUpdate:
    """Plan the update that answers a look. budget_bytes, superseded : as in node.foveate.plan_update.

    Raises LatticeError where the parameters describe no lattice or contradict each other.
    """
    if state.looks == FOVEAE_MAX:
        raise LatticeError(f"{FOVEAE_MAX} foveae are all that one opening can tell apart: open the scan anew")
    state = replace(state, looks=state.looks + 1)
    left = math.inf if budget_bytes is None else budget_bytes - REPLY_BYTES
    if scan.spec.geometry == "sphere":
        return _plan_sphere(scan, state, look, left, superseded)
    if look.classic is not None and look.classic.sphere is not None:
        raise LatticeError("a cylinder has no directions: `sphere` goes with a spherical scan")
    search = _Search(scan, state, look, look.classic or _viewers_choice(look), left, superseded)
    try:
        coded = search.largest()
    except _Superseded:
        return ClassicUpdate((), state, "superseded")
    for one in coded:
        state = replace(state, holdings=one.held_by(state.holdings))
    return ClassicUpdate(coded, state, "byte limit" if search.limited else "complete", encodes=search.encodes)


def _plan_sphere(
    scan: Scan, state: ClassicState, look: Look, left: float, superseded: Callable[[], bool]
) -> ClassicUpdate:
    """The lattice asked for, if it fits; rings over the window, or over as much of it as fits, where none is."""
    wanted = look.classic or ClassicLookParameters(ClassicRange(), ClassicTexture())
    for tries in range(SHRINKS):
        if superseded():
            return ClassicUpdate((), state, "superseded")
        sphere = wanted.sphere or window_rings(look, SHRINK**tries)
        coded = code_sphere(scan, state, look, msgspec.structs.replace(wanted, sphere=sphere))
        if sum(one.wire_bytes for one in coded) <= left:
            for one in coded:
                state = replace(state, holdings=one.held_by(state.holdings))
            return ClassicUpdate(coded, state, "byte limit" if tries else "complete", encodes=(tries + 1) * len(coded))
        if wanted.sphere is not None:
            break
    return ClassicUpdate((), state, "byte limit")


class _Superseded(Exception):
    """A newer look has come."""


class _Search:
    """The largest scale whose update fits.   limited : a smaller one, or less than was wanted, had to do."""

    def __init__(
        self,
        scan: Scan,
        state: ClassicState,
        look: Look,
        wanted: ClassicLookParameters,
        left: float,
        superseded: Callable[[], bool],
    ) -> None:
        self._scan, self._state, self._look, self._wanted = scan, state, look, wanted
        self._left, self._superseded = left, superseded
        self.limited = False
        self.encodes = 0

    def largest(self) -> tuple[ClassicCoded, ...]:
        """The best update: of mesh and texture, else of the mesh alone, else nothing."""
        while self._wanted.range or self._wanted.texture:
            coded = self._largest_of_wanted()
            if coded is not None:
                return coded
            self._wanted = ClassicLookParameters(self._wanted.range if self._wanted.texture else None)
        return ()

    def _largest_of_wanted(self) -> tuple[ClassicCoded, ...] | None:
        low, high = SCALE_MIN, self._scale_max()
        best = self._fitting(high)
        if best is not None or not high:
            return best
        best = self._fitting(low)
        for _ in range(BISECTIONS if best is not None else 0):
            middle = math.sqrt(low * high)
            coded = self._fitting(middle)
            low, high, best = (middle, high, coded) if coded is not None else (low, middle, best)
        return best

    def _scale_max(self) -> float:
        """The scale at which every channel that leaves it open samples its fovea fully; 0 when none does (F-06)."""
        texture, mesh = self._wanted.texture, self._wanted.range
        of_texture = finest_scale(texture.alpha) if texture and _open(texture) else 0.0
        return max(of_texture, finest_scale(mesh.alpha) * self._texels_per_column if mesh and _open(mesh) else 0.0)

    def _fitting(self, scale: float) -> tuple[ClassicCoded, ...] | None:
        coded = tuple(one for one in (self._code_range(scale), self._code_texture(scale)) if one is not None)
        if sum(one.wire_bytes for one in coded) <= self._left:
            return coded
        self.limited = True
        return None

    def _code_range(self, scale: float) -> ClassicCoded | None:
        wanted, shape = self._wanted.range, self._state.shapes[Channel.RANGE]
        if wanted is None:
            return None
        self._count_encode()
        parameters = self._parameters(shape, wanted, scale / self._texels_per_column)
        return code_classic_range(self._scan, self._state.holdings, shape, parameters)

    def _code_texture(self, scale: float) -> ClassicCoded | None:
        wanted, shape = self._wanted.texture, self._state.shapes[Channel.TEXTURE]
        if wanted is None:
            return None
        self._count_encode()
        parameters = self._parameters(shape, wanted, scale)
        return code_classic_texture(self._scan, self._state.holdings, shape, parameters, wanted.q)

    def _parameters(
        self, shape: ChannelShape, wanted: ClassicRange | ClassicTexture, scale: float
    ) -> ClassicParameters:
        alpha, look = wanted.alpha, self._look
        if wanted.s is not None and wanted.sigma is not None:
            raise LatticeError("a classic fovea takes s or sigma, not both")
        if wanted.sigma is not None:
            s_x = scale_from_sigma(wanted.sigma, shape.width / 2, alpha)
            s_y = scale_from_sigma(wanted.sigma, max(shape.height - 1.0, 0.5), alpha)
        else:
            s_x = s_y = min(scale, finest_scale(alpha)) if wanted.s is None else wanted.s
        x, y = int(look.u * shape.width), int(look.v * shape.height)
        alpha = single(alpha)
        return ClassicParameters(self._state.looks, x, y, alpha, alpha, single(s_x), single(s_y))

    @property
    def _texels_per_column(self) -> float:
        """The paper's N."""
        return self._scan.spec.texture_width / self._scan.spec.width

    def _count_encode(self) -> None:
        if self._superseded():
            raise _Superseded
        self.encodes += 1


def _viewers_choice(look: Look) -> ClassicLookParameters:
    """Mesh and texture by the viewer's two knobs, as far as they are turned."""
    knobs: dict[str, Any] = {"sigma": look.scale} if look.alpha is None else {"sigma": look.scale, "alpha": look.alpha}
    return ClassicLookParameters(ClassicRange(**knobs), ClassicTexture(**knobs))


def _open(wanted: ClassicRange | ClassicTexture) -> bool:
    """Whether the scale is left to us."""
    return wanted.s is None and wanted.sigma is None
