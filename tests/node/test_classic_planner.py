from collections.abc import Callable
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
import pytest

from client.classic_model import ClassicModel
from client.errors import HoldingsDiffer
from node.classic import ClassicState, ClassicView, build_classic_view
from node.classic_planner import FOVEAE_MAX, ClassicUpdate, plan_classic
from node.foveate import REPLY_BYTES
from node.library import Scan
from protocol.classic import ClassicParameters
from protocol.errors import LatticeError
from protocol.fovea import finest_scale
from protocol.lattice import Channel
from protocol.messages import ClassicLookParameters, Look
from protocol.refinement import Refinement


@pytest.fixture(scope="module")
def view(scan: Scan) -> ClassicView:
    return build_classic_view(scan, "htj2k")


def ask(u: float = 0.5, v: float = 0.5, parameters: dict[str, Any] | None = None, **knobs: float) -> Look:
    explicit = None if parameters is None else msgspec.convert(parameters, ClassicLookParameters)
    return Look(1, u, v, profile="classic", classic=explicit, **knobs)  # type: ignore[arg-type]


def wire_bytes(update: ClassicUpdate) -> int:
    return REPLY_BYTES + sum(one.wire_bytes for one in update.coded)


class Client:
    """A model fed by the planner, which must agree with the node after every update."""

    def __init__(self, scan: Scan, view: ClassicView) -> None:
        self.scan, self.state, self.model = scan, view.state, ClassicModel(view.info)
        for data in view.refinements(1):
            self.model.apply(Refinement.from_bytes(data))

    def look(self, look: Look) -> ClassicUpdate:
        update = plan_classic(self.scan, self.state, look)
        for seq, coded in enumerate(update.coded, 2):
            self.model.apply(Refinement.from_bytes(coded.refinement(1, seq, 1).to_bytes()))
        self.state = update.state
        assert self.model.digest() == self.state.holdings.digest()
        return update


def test_model_and_node_agree_over_many_looks(scan: Scan, view: ClassicView) -> None:
    client, random = Client(scan, view), np.random.default_rng(3)
    for number in range(1, 31):
        alpha = float(random.choice([0.03, 0.2, 1.0]))
        u, v = random.random(2).tolist()
        update = client.look(ask(u, v, {"range": {"alpha": alpha}, "texture": {"alpha": alpha}}))
        assert client.state.looks == number
        assert all(one.lattice.parameters.fovea == number for one in update.coded)
    owners = np.unique(client.model.owner)
    assert owners.max() <= 30 and owners.size > 10


def test_every_other_cell_stays_as_it_is(scan: Scan, view: ClassicView) -> None:
    client = Client(scan, view)
    for u in (0.3, 0.35):
        before = client.model.range_mm, client.model.texture.copy(), client.model.owner
        client.look(ask(u, parameters={"range": {"alpha": 0.5}, "texture": {"alpha": 0.3}}))
        same = client.model.owner == before[2]
        np.testing.assert_array_equal(client.model.range_mm[same], before[0][same])
        assert 0 < (client.model.texture != before[1]).any(2).mean() < 0.2


def test_spacing_grows_away_from_the_fovea(scan: Scan, view: ClassicView) -> None:
    client = Client(scan, view)
    client.look(ask(0.5, 0.5, {"range": {"alpha": 0.2}}))
    spacing = client.model.spacing[48, 80:]
    owned = client.model.owner[48, 80:] == 1
    assert spacing[0] == pytest.approx(np.log1p(0.2) / 0.2, rel=1e-5)
    assert (np.diff(spacing[owned]) > 0).all()


@pytest.mark.parametrize("budget", [*range(0, 900, 60), 1500, 3000, 8000])
def test_never_a_byte_over_and_more_detail_with_more(scan: Scan, view: ClassicView, budget: int) -> None:
    update = plan_classic(scan, view.state, ask(), budget)
    assert not update.coded or wire_bytes(update) <= budget
    free = plan_classic(scan, view.state, ask())
    assert (update.reason == "complete") == (wire_bytes(free) <= budget)


def parameters_of(update: ClassicUpdate) -> list[ClassicParameters]:
    found = [one.lattice.parameters for one in update.coded]
    return [p for p in found if isinstance(p, ClassicParameters)]


def test_without_a_budget_every_scale_is_the_finest(scan: Scan, view: ClassicView) -> None:
    update = plan_classic(scan, view.state, ask(alpha=0.5))
    assert update.reason == "complete" and update.encodes == 2
    for p in parameters_of(update):
        assert p.s_x == pytest.approx(finest_scale(0.5), rel=1e-6)


def test_mesh_and_texture_share_one_scale(scan: Scan, view: ClassicView) -> None:  # F-14: S and S/N
    update = plan_classic(scan, view.state, ask(alpha=0.05), 700)
    mesh, texture = (p.s_x for p in parameters_of(update))
    assert update.reason == "byte limit" and texture == pytest.approx(4 * mesh, rel=1e-6)


def test_where_both_do_not_fit_the_mesh_goes_alone(scan: Scan, view: ClassicView) -> None:
    explicit = {"range": {"alpha": 0.5}, "texture": {"alpha": 0.03, "s": 33}}
    update = plan_classic(scan, view.state, ask(parameters=explicit), 900)
    assert [one.lattice.shape.channel for one in update.coded] == [Channel.RANGE]
    assert update.reason == "byte limit"
    assert plan_classic(scan, view.state, ask(parameters=explicit), REPLY_BYTES + 60).coded == ()


def test_the_viewers_knobs_are_alpha_and_sigma(scan: Scan, view: ClassicView) -> None:
    update = plan_classic(scan, view.state, ask(alpha=0.5, scale=0.05))
    for p, one in zip(parameters_of(update), update.coded, strict=True):
        width = one.lattice.shape.width
        assert p.alpha_x == p.alpha_y == 0.5
        assert p.s_x == pytest.approx(0.05 * (width / 2) / np.log1p(0.25 * width), rel=1e-6)


@pytest.mark.parametrize(
    "parameters",
    [{"range": {"s": 1, "sigma": 0.5}}, {"range": {"alpha": 0.005, "s": 9999}}, {"texture": {"sigma": 1e-9}}],
)
def test_contradictions_and_lattices_without_end_are_refused(scan: Scan, view: ClassicView, parameters: Any) -> None:
    with pytest.raises(LatticeError):
        plan_classic(scan, view.state, ask(parameters=parameters))


def test_a_newer_look_stops_the_search_and_changes_nothing(scan: Scan, view: ClassicView) -> None:
    left = iter([False, False, False, True])
    update = plan_classic(scan, view.state, ask(), 2000, lambda: next(left))
    assert (update.coded, update.reason) == ((), "superseded")


def test_foveae_can_be_counted_only_so_far(scan: Scan, view: ClassicView) -> None:
    with pytest.raises(LatticeError, match="anew"):
        plan_classic(scan, ClassicState(view.state.shapes, looks=FOVEAE_MAX), ask())


@pytest.mark.parametrize("spoil", [lambda r: r.samples + 1, lambda r: 0], ids=["one more", "none"])
def test_a_client_that_counts_otherwise_objects(
    scan: Scan, view: ClassicView, spoil: Callable[[Refinement], int]
) -> None:
    client = Client(scan, view)
    (coded, _) = plan_classic(scan, view.state, ask()).coded
    honest = coded.refinement(1, 2, 1)
    with pytest.raises(HoldingsDiffer):
        client.model.apply(replace(honest, samples=spoil(honest)))
    client.model.apply(honest)
