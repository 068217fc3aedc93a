"""Small channels and lattices of every kind, for hypothesis: cut blocks, one block wide, one row high, rings, seams."""

import numpy as np
from hypothesis import strategies as st

from protocol.lattice import NO_SKIRT, RHO_MAX, RHO_ONE, Channel, ChannelShape, Parameters, mask_to_runs

WIDTHS = {
    Channel.RANGE: (1, 2, 4, 7, 8, 9, 12, 16, 20, 24, 36, 40, 64),
    Channel.TEXTURE: (1, 3, 15, 16, 17, 31, 32, 33, 48, 50, 96),
}
HEIGHTS = {Channel.RANGE: (1, 2, 7, 8, 9, 15, 17, 24, 33), Channel.TEXTURE: (1, 2, 15, 16, 17, 30, 33, 49)}
RHO = st.one_of(
    st.sampled_from((NO_SKIRT, RHO_ONE, RHO_MAX)), st.integers(RHO_ONE, RHO_ONE * 2), st.integers(RHO_ONE, RHO_ONE * 4)
)


@st.composite
def shapes(draw: st.DrawFn, channel: Channel | None = None) -> ChannelShape:
    kind = draw(st.sampled_from(Channel)) if channel is None else channel
    width, height = draw(st.sampled_from(WIDTHS[kind])), draw(st.sampled_from(HEIGHTS[kind]))
    return ChannelShape(kind, width, height, draw(st.integers(1, width)), draw(st.integers(1, height)))


@st.composite
def parameters_in(draw: st.DrawFn, shape: ChannelShape, listed: bool = False) -> Parameters:
    rows, columns = shape.blocks
    fits = [half for half in shape.half_spacings if 2 * shape.width % half == 0]
    wide = draw(st.integers(1, columns))
    block_x = 0 if wide == columns else draw(st.integers(0, columns - 1))
    free = shape.channel is Channel.TEXTURE and wide < columns
    half = draw(st.sampled_from(shape.half_spacings if free else fits))
    block_y = draw(st.integers(0, rows - 1))
    high = draw(st.integers(1, rows - block_y))
    runs = None
    if listed or draw(st.integers(0, 3)) == 0:
        runs = mask_to_runs(np.array(draw(st.lists(st.booleans(), min_size=high * wide, max_size=high * wide))))
    return Parameters(half, block_x, block_y, wide, high, draw(RHO), draw(RHO), runs)


@st.composite
def windows(draw: st.DrawFn) -> tuple[ChannelShape, Parameters]:
    """Lattices that do not go all round, on grids of whole blocks, so that they may stand elsewhere as well."""
    whole = shapes().filter(lambda shape: shape.width % shape.block == 0 and shape.width > shape.block)
    shape = draw(whole)
    return shape, draw(parameters_in(shape).filter(lambda p: p.blocks_wide < shape.blocks[1]))


@st.composite
def lattices(draw: st.DrawFn, channel: Channel | None = None, listed: bool = False) -> tuple[ChannelShape, Parameters]:
    shape = draw(shapes(channel))
    return shape, draw(parameters_in(shape, listed))
