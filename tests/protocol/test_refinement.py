import struct
import zlib
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.classic import ClassicParameters
from protocol.errors import LocalWireError, RemoteWireError
from protocol.lattice import NO_SKIRT, STRIDE_SETS, Channel, Parameters, mask_to_runs
from protocol.refinement import (
    CRC,
    HEADER,
    MASK_MAX,
    PARAMETERS_MAX,
    PAYLOAD_MAX,
    Generator,
    Refinement,
    pack_parameters,
    unpack_parameters,
)

U16, U32 = st.integers(0, 0xFFFF), st.integers(0, 0xFFFFFFFF)
RUNS = st.none() | st.lists(st.integers(0, 2**22), min_size=1, max_size=20).map(tuple)
PARAMETERS = st.builds(
    Parameters, st.integers(0, 31), U16, U16, U16, U16, U32, U32, RUNS, st.sampled_from(STRIDE_SETS)
) | st.builds(Parameters, st.integers(0, 31), U16, U16, U16, U16, U32, U32, RUNS, polar=st.just(True))
REFINEMENTS = st.builds(
    Refinement,
    generator=st.just(Generator.FOVEA),
    channel=st.sampled_from(Channel),
    epoch=U16,
    seq=U32,
    look=U32,
    codec=st.integers(0, 255),
    quality=U16,
    samples=U32,
    payload=st.binary(max_size=200),
    mask=st.binary(max_size=50),
    parameters=PARAMETERS,
    self_contained=st.booleans(),
)
FOVEA = Refinement(
    Generator.FOVEA,
    Channel.RANGE,
    3,
    7,
    12,
    1,
    2,
    289,
    b"payload",
    b"mask",
    Parameters(4, 44, 5, 2, 2, 1, 2, (1, 3)),
    True,
)


@given(REFINEMENTS)
def test_bytes_are_inverse(refinement: Refinement) -> None:
    assert Refinement.from_bytes(refinement.to_bytes()) == refinement


def test_a_first_view_carries_no_parameters() -> None:
    first = Refinement(Generator.COARSE, Channel.TEXTURE, 1, 0, 0, 2, 60, 8192, b"x")
    assert Refinement.from_bytes(first.to_bytes()) == first
    for wrong in (Generator.COARSE, Parameters(2, 0, 0, 1, 1)), (Generator.FOVEA, None):
        data = Refinement(wrong[0], Channel.RANGE, 1, 0, 0, 0, 1, 1, b"", b"", wrong[1]).to_bytes()
        with pytest.raises(RemoteWireError):
            Refinement.from_bytes(data)


def test_a_classic_fovea_has_parameters_of_its_own() -> None:
    fovea = ClassicParameters(2, 180, 50, 0.5, 0.5, 2.0, 1.5)
    classic = Refinement(Generator.CLASSIC, Channel.RANGE, 1, 2, 7, 0, 1, 3, b"abcdef", b"", fovea)
    data = classic.to_bytes()
    assert Refinement.from_bytes(data) == classic
    assert data[HEADER.size : HEADER.size + 22] == struct.pack("<HHHffff", 2, 180, 50, 0.5, 0.5, 2.0, 1.5)
    assert len(data) == HEADER.size + 22 + 6 + CRC.size and HEADER.size + 22 + CRC.size <= 64
    for wrong in (None, Parameters(2, 0, 0, 1, 1)):
        with pytest.raises(RemoteWireError):
            Refinement.from_bytes(replace(classic, parameters=wrong).to_bytes())


def test_the_layout_is_the_documented_one() -> None:
    parameters = struct.pack("<BHHHHII", 4, 44, 5, 2, 2, 1, 2) + bytes([0x62])
    header = struct.pack("<HBBBBBBHHIIIHHII", 0x5246, 1, 1, 0, 1, 1, 0, 3, 2, 7, 12, 289, len(parameters), 0, 4, 7)
    body = header + parameters + b"mask" + b"payload"
    assert FOVEA.to_bytes() == body + struct.pack("<I", zlib.crc32(body))
    assert HEADER.size + 17 + CRC.size == 57 <= 64


@given(st.data())
def test_any_damage_is_noticed(data: st.DataObject) -> None:
    whole = bytearray(FOVEA.to_bytes())
    kind = data.draw(st.sampled_from(("flip", "cut", "more")))
    if kind == "flip":
        bit = data.draw(st.integers(0, len(whole) * 8 - 1))
        whole[bit // 8] ^= 1 << bit % 8
    elif kind == "cut":
        del whole[data.draw(st.integers(0, len(whole) - 1)) :]
    else:
        whole += data.draw(st.binary(min_size=1, max_size=9))
    with pytest.raises(RemoteWireError):
        Refinement.from_bytes(bytes(whole))


@given(st.binary(max_size=300))
def test_noise_is_refused(data: bytes) -> None:
    with pytest.raises(RemoteWireError):
        Refinement.from_bytes(data)


@given(st.binary(max_size=60), st.integers(0, 255), st.integers(0, 255))
def test_intact_checksums_do_not_help_nonsense(parameters: bytes, generator: int, channel: int) -> None:
    body = HEADER.pack(0x5246, 1, generator, channel, 0, 0, 0, 0, 0, 0, 0, 0, len(parameters), 0, 0, 0) + parameters
    try:
        found = Refinement.from_bytes(body + CRC.pack(zlib.crc32(body)))
    except RemoteWireError:
        return
    assert found.generator == generator and found.channel == channel


@pytest.mark.parametrize(
    "sizes", [(PARAMETERS_MAX + 1, 0, 0), (17, MASK_MAX + 1, 0), (17, 0, PAYLOAD_MAX + 1), (17, 0, 0xFFFFFFFF)]
)
def test_announced_sizes_are_bounded_before_anything_is_read(sizes: tuple[int, int, int]) -> None:
    header = HEADER.pack(0x5246, 1, 1, 0, 0, 0, 0, 0, 1, 0, 0, 1, sizes[0], 0, *sizes[1:])
    with pytest.raises(RemoteWireError, match="more than is allowed"):
        Refinement.from_bytes(header + bytes(4))


@given(PARAMETERS)
def test_parameters_are_inverse(parameters: Parameters) -> None:
    data = pack_parameters(parameters)
    assert unpack_parameters(data) == parameters
    assert parameters.listed or len(data) == 17


def test_no_skirt_travels_as_nought() -> None:
    assert pack_parameters(Parameters(2, 0, 0, 1, 1))[-8:] == bytes(8) and NO_SKIRT == 0


@pytest.mark.parametrize("tail", [b"\x01", b"\x12", b"\xff", b"\xff" * 5 + b"\x00", b"\x02\x0f\xff"])
def test_run_lengths_out_of_bounds_are_refused(tail: bytes) -> None:
    with pytest.raises(RemoteWireError):
        unpack_parameters(pack_parameters(Parameters(2, 0, 0, 1, 1)) + tail)


def test_runs_of_a_round_window_take_about_half_a_byte_each() -> None:
    data = pack_parameters(Parameters(2, 0, 0, 4, 19, listed=(2, 3, 2, 5, 60, 4)))
    assert data[17:] == bytes.fromhex("64 40 df 1c f1")  # PROTOCOL.md, "Refinement"
    row, column = np.mgrid[-18:19, -18:19]
    runs = mask_to_runs(np.hypot(row, column) < 18.4)
    assert len(pack_parameters(Parameters(2, 0, 0, 37, 37, listed=runs))) - 17 < 0.65 * len(runs)


@pytest.mark.parametrize("size", range(17))
def test_parameters_cut_short_are_refused(size: int) -> None:
    with pytest.raises(RemoteWireError):
        unpack_parameters(bytes(size))


@pytest.mark.parametrize(
    "parameters",
    [
        Parameters(2, -1, 0, 1, 1),
        Parameters(2, 70000, 0, 1, 1),
        Parameters(256, 0, 0, 1, 1),
        Parameters(2, 0, 0, 1, 1, strides=(1, 8)),
        Parameters(2, 0, 0, 1, 1, 2**32),
        Parameters(2, 0, 0, 1, 1, listed=()),
        Parameters(2, 0, 0, 1, 1, listed=(-1, 2)),
        Parameters(2, 0, 0, 1, 1, listed=(2**35,)),
    ],
)
def test_parameters_that_do_not_fit_are_refused(parameters: Parameters) -> None:
    with pytest.raises(LocalWireError):
        pack_parameters(parameters)


@pytest.mark.parametrize(
    "field", [{"epoch": 70000}, {"seq": 2**32}, {"quality": -1}, {"codec": 256}, {"mask": bytes(MASK_MAX + 1)}]
)
def test_refinements_that_do_not_fit_are_refused(field: dict[str, int]) -> None:
    with pytest.raises(LocalWireError):
        replace(FOVEA, **field).to_bytes()  # type: ignore[arg-type]
    listed = tuple([1] * 2 * PARAMETERS_MAX)
    with pytest.raises(LocalWireError):
        replace(FOVEA, parameters=Parameters(2, 0, 0, 1, 1, listed=listed)).to_bytes()
