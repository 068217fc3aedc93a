import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.classic import (
    PARAMETERS,
    ClassicLattice,
    ClassicParameters,
    Foveae,
    bounds,
    build_classic,
    claim,
    first_view_places,
    first_view_positions,
    first_view_quads,
    first_view_shape,
    kept_samples,
    nearest_fovea,
    single,
)
from protocol.errors import LatticeError, LocalWireError, RemoteWireError
from protocol.fovea import finest_scale
from protocol.lattice import Channel, ChannelShape

PAPER = ChannelShape(Channel.RANGE, 360, 100, 20, 10)
SMALL = ChannelShape(Channel.RANGE, 36, 20, 4, 3)
ODD = ChannelShape(Channel.TEXTURE, 23, 7, 5, 2)
ROWS, COLUMNS = np.arange(SMALL.height), np.arange(SMALL.width)


def fovea(x: int, y: int, alpha: float = 0.5, s: float | None = None, number: int = 1) -> ClassicParameters:
    scale = single(finest_scale(alpha) if s is None else s)
    return ClassicParameters(number, x, y, single(alpha), single(alpha), scale, scale)


FOVEAE = st.lists(
    st.tuples(
        st.integers(0, SMALL.width - 1),
        st.integers(0, SMALL.height - 1),
        st.sampled_from([0.05, 0.1, 0.5, 2.0]),
        st.sampled_from([None, 0.8, 3.0, 9.0]),
    ),
    min_size=1,
    max_size=6,
).map(lambda some: [build_classic(SMALL, fovea(*one, number=n)) for n, one in enumerate(some, 1)])


@given(
    st.integers(0, 65535), st.integers(0, 65535), st.integers(0, 65535),
    st.floats(0.125, 64, width=32), st.floats(0.125, 65536, width=32),
)  # fmt: skip
def test_parameters_are_inverse(number: int, x: int, y: int, alpha: float, s: float) -> None:
    parameters = ClassicParameters(number, x, y, alpha, alpha, s, s)
    assert ClassicParameters.from_bytes(parameters.to_bytes()) == parameters
    assert len(parameters.to_bytes()) == PARAMETERS.size == 22


@pytest.mark.parametrize("size", [0, 21, 23])
def test_parameters_that_are_not_whole_are_refused(size: int) -> None:
    with pytest.raises(RemoteWireError):
        ClassicParameters.from_bytes(bytes(size))


@pytest.mark.parametrize("wrong", [ClassicParameters(65536, 0, 0, 1, 1, 1, 1), ClassicParameters(1, -1, 0, 1, 1, 1, 1)])
def test_parameters_that_do_not_fit_are_refused(wrong: ClassicParameters) -> None:
    with pytest.raises(LocalWireError):
        wrong.to_bytes()


@pytest.mark.parametrize(
    ("alpha", "s", "samples"), [(0.5, 1.995, 143), (0.5, finest_scale(0.5), 221), (0.1, finest_scale(0.1), 2257)]
)
def test_the_papers_patch_has_so_many_samples(alpha: float, s: float, samples: int) -> None:  # F-07
    lattice = build_classic(PAPER, fovea(180, 50, alpha, s))
    assert lattice.x.size * lattice.y.size == samples


def test_samples_stand_where_the_transform_puts_them() -> None:
    lattice = build_classic(PAPER, fovea(3, 50, 0.5, 1.995))
    right = np.array([math.expm1(k / single(1.995)) / 0.5 for k in range(7)])
    np.testing.assert_allclose(lattice.x[6:], 3 + right, rtol=1e-12)
    np.testing.assert_allclose(lattice.x[:7], 3 - right[::-1], rtol=1e-12)
    assert lattice.wrapped_columns[0] == 360 + math.ceil(3 - right[-1])


@pytest.mark.parametrize(
    "wrong",
    [
        fovea(360, 0), fovea(0, 100), fovea(0, 0, number=0), fovea(0, 0, 0.0005, 1.0), fovea(0, 0, 0.5, 2e5),
        fovea(0, 0, math.nan, 1.0), fovea(0, 0, 0.5, math.inf), fovea(0, 0, 0.005, 9e4),
    ],
)  # fmt: skip
def test_what_describes_no_lattice_is_refused(wrong: ClassicParameters) -> None:
    with pytest.raises(LatticeError):
        build_classic(PAPER, wrong)


@pytest.mark.parametrize(
    ("size", "channel", "shape"),
    [
        ((360, 100), Channel.RANGE, (10, 20)), ((1024, 256), Channel.TEXTURE, (64, 256)),
        ((1440, 1024), Channel.RANGE, (102, 80)), ((4096, 2048), Channel.TEXTURE, (128, 256)),
        ((8192, 4096), Channel.TEXTURE, (128, 256)), ((1, 1), Channel.RANGE, (1, 1)), ((8, 3), Channel.RANGE, (2, 1)),
    ],
)  # fmt: skip
def test_first_views_are_the_papers_size_or_bounded(
    size: tuple[int, int], channel: Channel, shape: tuple[int, int]
) -> None:
    assert first_view_shape(*size, channel) == shape


def test_the_first_view_stands_on_the_first_and_the_last_row() -> None:
    rows, columns = first_view_positions(PAPER)
    np.testing.assert_array_equal(rows, 11 * np.arange(10))
    np.testing.assert_array_equal(columns, 18 * np.arange(20))
    y, x = first_view_places(PAPER)
    assert (y.low[99], y.high[99], y.part[99]) == (9, 9, 0)
    assert (x.low[351], x.high[351], x.part[351]) == (19, 0, 0.5)
    quads = first_view_quads(PAPER)
    assert quads.shape == (180, 4)
    assert np.bincount(quads.ravel()).tolist() == [2] * 20 + [4] * 160 + [2] * 20


@given(FOVEAE)
def test_the_nearest_fovea_that_delivers_owns(foveae: list[ClassicLattice]) -> None:
    owner, distance = nearest_fovea(foveae, ROWS, COLUMNS)
    for row in range(0, SMALL.height, 3):
        for column in range(0, SMALL.width, 5):
            reach = [away(one, row, column) for one in foveae]
            delivered = [value for value in reach if value is not None]
            assert owner[row, column] == (1 + reach.index(min(delivered)) if delivered else 0)
            assert not delivered or distance[row, column] == min(delivered)


@given(FOVEAE, st.randoms())
def test_order_matters_only_where_two_are_equally_near(foveae: list[ClassicLattice], random: st.DataObject) -> None:
    owner, distance = nearest_fovea(foveae, ROWS, COLUMNS)
    shuffled = foveae.copy()
    random.shuffle(shuffled)  # type: ignore[attr-defined]
    other, same = nearest_fovea(shuffled, ROWS, COLUMNS)
    np.testing.assert_array_equal(same, distance)
    for row, column in np.argwhere(other != owner):
        pair = [away(foveae[number - 1], row, column) for number in (owner[row, column], other[row, column])]
        assert pair[0] == pair[1]


@given(FOVEAE)
def test_distance_never_grows_and_only_claimed_samples_change_hands(foveae: list[ClassicLattice]) -> None:
    owner, distance = nearest_fovea([], ROWS, COLUMNS)
    for count, new in enumerate(foveae):
        claimed = claim(new, foveae[:count])
        later, nearer = nearest_fovea(foveae[: count + 1], ROWS, COLUMNS)
        assert (nearer <= distance).all()
        changed = np.zeros(later.shape, bool)
        changed[np.ix_(new.rows, new.wrapped_columns)] = claimed
        assert (later[changed] == count + 1).all()
        np.testing.assert_array_equal(later[~changed], owner[~changed])
        owner, distance = later, nearer


@given(FOVEAE)
def test_the_same_fovea_twice_claims_nothing(foveae: list[ClassicLattice]) -> None:
    assert not any(claim(one, foveae).any() for one in foveae)


@given(FOVEAE)
def test_what_is_kept_is_enough_and_nothing_is_kept_for_nothing(foveae: list[ClassicLattice]) -> None:
    *older, new = foveae
    claimed = claim(new, older)
    kept = kept_samples(new, claimed)
    y, x = new.places()
    for rows in (y.low, y.high):
        for columns in (x.low, x.high):
            assert kept[np.ix_(rows, columns)][claimed].all()
    assert kept.any() == claimed.any()


@pytest.mark.parametrize("shape", [PAPER, SMALL, ODD])
@given(st.floats(0.01, 4), st.floats(0.1, 12), st.integers(0, 359), st.integers(0, 99))
def test_the_first_fovea_keeps_all_its_samples(shape: ChannelShape, alpha: float, s: float, x: int, y: int) -> None:
    lattice = build_classic(shape, fovea(x % shape.width, y % shape.height, alpha, s))
    claimed = claim(lattice, [])
    assert claimed.all() and kept_samples(lattice, claimed).all()
    assert lattice.columns.size <= shape.width and len(set(lattice.wrapped_columns)) == lattice.columns.size
    assert lattice.rows[0] >= 0 and lattice.rows[-1] < shape.height


def test_bounds_are_the_smallest_rectangle() -> None:
    mask = np.zeros((5, 6), bool)
    mask[1, 4] = mask[3, 2] = True
    assert bounds(mask) == (slice(1, 4), slice(2, 5))


def test_the_digest_tells_what_was_claimed_and_received() -> None:
    one, two = (build_classic(SMALL, fovea(x, 5, number=x)) for x in (4, 9))
    held = Foveae().adopt(one, claim(one, []), b"ab")
    assert held.digest() == Foveae().adopt(one, claim(one, []), b"ab").digest()
    others = [
        Foveae(),
        Foveae().adopt(one, claim(one, []), b"ac"),
        Foveae().adopt(one, claim(one, [two]), b"ab"),
        Foveae().adopt(two, claim(two, []), b"ab"),
        held.adopt(two, claim(two, [one]), b"ab"),
    ]
    assert held.digest() not in {other.digest() for other in others}
    assert others[-1].first(1) == held
    assert others[-1].of(Channel.RANGE) == [one, two] and not held.of(Channel.TEXTURE)
    with pytest.raises(LatticeError):
        held.first(2)


def away(one: ClassicLattice, row: int, column: int) -> int | None:
    """L1 distance, cyclic in x, where the fovea delivers."""
    turns = [column + turn * SMALL.width for turn in (-1, 0, 1)]
    inside = [at for at in turns if one.x[0] <= at <= one.x[-1]]
    if not inside or not one.y[0] <= row <= one.y[-1]:
        return None
    return min(abs(at - one.parameters.x) for at in turns) + abs(row - one.parameters.y)
