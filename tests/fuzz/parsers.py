"""Every parser of bytes that somebody else wrote, with valid ones to begin with, and what it may raise: our errors.

    foveascan bench fuzz --target refinement --count 100000 --seed 3
"""

from __future__ import annotations

import io
import math
import shutil
import zipfile
import zlib
from collections.abc import Iterable, Sequence
from functools import partial
from pathlib import Path

import msgspec
import numpy as np

from client.classic_model import ClassicModel
from client.model import Model
from exchange.formats import ReadOptions, read_scan, writer_of
from exchange.native import read_native
from node.access import Access, access_folder
from node.archive import backup, restore
from node.config import load_config
from node.journal import survey_journal
from node.journal_records import encode_entry, encode_opening, encode_record
from node.library import About, Library
from node.sidecar import decode_changes
from protocol import messages as m
from protocol import pairing
from protocol.codec import (
    RangeCodec,
    TextureCodec,
    decode_mask,
    decode_range,
    decode_texture,
    encode_mask,
    encode_range,
    encode_texture,
)
from protocol.errors import FoveascanError
from protocol.framing import FrameReader, encode_frame
from protocol.grid import StepArray
from protocol.holdings import ChannelHoldings, texture_rank
from protocol.lattice import Channel, Parameters
from protocol.live import LiveColumns, is_live
from protocol.refinement import CRC, Generator, Refinement
from protocol.scanner_link import Role, ScannerLink
from protocol.scanner_messages import (
    DeviceInfo,
    RangeColumn,
    SweepHeader,
    TextureColumn,
    decode_message,
    encode_message,
    is_known,
)
from protocol.session import Role as End
from protocol.session import Session
from protocol.sphere_fovea import Kind
from protocol.sphere_fovea import SphereParameters as ClassicSphere
from protocol.strips import build_strips, image_shapes, select_strips
from tests.client.scripted_node import Planner, synthetic_grid
from tests.client.test_classic_model import INFO as CLASSIC
from tests.client.test_classic_model import first_view, range_fovea, texture_fovea
from tests.client.test_sphere_model import STEPS
from tests.exchange.grids import vase
from tests.exchange.test_echo import echo
from tests.fuzz.kept import of_disks, of_hearsay
from tests.fuzz.target import Target
from tests.golden.write_sphere import RANGE, TEXTURE
from tests.protocol.test_scanner_messages import SPEC, TABLE

SMALL = ReadOptions(size=(24, 12, 32, 16))
SAID = (
    m.Hello(m.PROTOCOL, "x"), m.Open(1, "latest"), m.Look(2, 0.5, 0.5), m.Look(3, 0.1, 0.9, max_bytes=400, fill=True),
    m.Cancel(2), m.Ack(1, 2, "0" * 16, 1.0), m.State(1, 2, m.Statement([[5, 1, 2]], [[3, 0, 1]])), m.Envelope(4),
    m.Watch(True), m.Published("0" * 32), m.Goodbye("bye"), m.Refused(1, "busy", "x"),
    m.Updated(1, 2, "complete", 0.1),
)  # fmt: skip
SETTINGS = b"""
[capture]
scanner = "usb:1209:5ca1"
baud = 9600
[server]
listen = "[::1]:7"
trusted_proxies = ["::1"]
[log]
level = "error"
"""
PAIRING = (
    msgspec.json.encode(pairing.PairRequest("01" * 16, "ab" * 32)), b"ABCD-EFGH-IJKL-MNOP",
)  # fmt: skip


def targets(folder: Path) -> Iterable[Target]:
    """All of them. folder : for those that read files."""
    yield from _of_the_link()
    yield from _of_the_stream()
    yield from _of_codecs()
    yield from _of_files(folder)
    yield from _of_the_node(folder)
    yield from of_disks(folder)
    yield from of_hearsay()


# -- the scanner's line ------------------------------------------------------------------------------------------------


def _of_the_link() -> Iterable[Target]:
    payloads = [(message.TYPE, encode_message(message)) for message, _ in TABLE]
    frames = tuple(encode_frame(kind, payload, seq=n, session=7) for n, (kind, payload) in enumerate(payloads))
    yield Target("framing", (*frames, b"".join(frames)), _read_frames, ())
    yield Target("scanner-messages", tuple(bytes([kind]) + payload for kind, payload in payloads), _decode_scanner)
    yield Target("scanner-link", tuple(bytes([kind]) + payload for kind, payload in payloads), _through_link, ())


def _read_frames(data: bytes) -> None:
    reader = FrameReader()
    for at in range(0, len(data), 37):
        reader.receive_data(data[at : at + 37])
        while reader.next_event() is not None:
            pass


def _decode_scanner(data: bytes) -> None:
    if data and is_known(data[0]):  # as the link does
        said = decode_message(data[0], data[1:])
        if isinstance(said, RangeColumn | TextureColumn):
            _ = said.samples


def _through_link(data: bytes) -> None:
    """As sound frames, so that what is wrong is what they say."""
    link = ScannerLink(Role.HOST, session=7)
    link.tick(0.0)
    link.greet()
    hello = encode_message(DeviceInfo("A7", 5, 1000, 100))
    link.receive_data(encode_frame(DeviceInfo.TYPE, hello, seq=0, session=7), 0.0)
    for seq, at in enumerate(range(0, len(data), 200), 1):
        part = data[at : at + 200]
        link.receive_data(encode_frame(part[0], part[1:], seq=seq, session=7), 0.0)
    while link.next_event() is not None:
        pass
    link.data_to_send()


# -- the stream --------------------------------------------------------------------------------------------------------


def _of_the_stream() -> Iterable[Target]:
    yield Target("control-messages", tuple(m.encode_message(said).encode() for said in SAID), m.decode_message)
    yield Target("session", tuple(m.encode_message(said).encode() for said in SAID), _to_a_node)
    planner = Planner(synthetic_grid())
    first = planner.first_view()
    foveae = (planner.range_fovea(), planner.texture_fovea())
    yield Target("model", tuple(one.to_bytes() for one in (*first, *foveae)), _ModelOf(planner.info, first))
    classic = (*first_view(), range_fovea(), texture_fovea())
    yield Target("classic-model", tuple(one.to_bytes() for one in classic), _ModelOf(CLASSIC, classic[:2]))
    strips = tuple(bytes.fromhex(step["refinement"]) for step in STEPS if step["refinement"])
    yield Target("sphere-model", (*strips, _round_a_pole().to_bytes()), _ModelOf(*_sphere()))
    classic_sphere = ClassicSphere(1, Kind.RINGS, 1 << 30, 0, 0.5, 0.1, rho=4)
    seen = Refinement(
        Generator.SPHERE, Channel.RANGE, 1, 2, 1, RangeCodec.RAW, 1, 4, bytes(8), parameters=classic_sphere
    )
    every = (*first, *foveae, *classic, seen)
    yield Target("refinement", (*(one.to_bytes() for one in every), *strips), _to_a_client)
    columns = (
        LiveColumns(Channel.RANGE, 1, (4, 5), 3, bytes(12)), LiveColumns(Channel.TEXTURE, 1, (4, 5), 3, bytes(18))
    )
    yield Target("live-columns", tuple(one.to_bytes() for one in columns), _to_a_client)


def _to_a_node(data: bytes) -> None:
    node = Session(End.NODE)
    node.send(m.ServerInfo(m.PROTOCOL, "n", "n", "0"))
    node.receive(m.encode_message(m.Hello(m.PROTOCOL, "x")))
    node.send(m.Welcome("view"))
    node.receive(data.decode(errors="surrogateescape"))


def _to_a_client(data: bytes) -> None:
    """Binary messages whose checksum was made right, as a client reads them."""
    client = Session(End.CLIENT)
    client.receive(m.encode_message(m.ServerInfo(m.PROTOCOL, "n", "n", "0")))
    client.send(m.Hello(m.PROTOCOL, "x"))
    client.receive(m.encode_message(m.Welcome("view")))
    said = client.receive(data if is_live(data) else _checked(data))
    if isinstance(said, LiveColumns):
        _ = said.samples


def _checked(data: bytes) -> bytes:
    whole = data[: -CRC.size]
    return whole + CRC.pack(zlib.crc32(whole))


class _ModelOf:
    """Applies refinements to a first view. Their checksum was made right, so what is wrong is what they say."""

    def __init__(self, info: m.ScanInfo, first: Sequence[Refinement]) -> None:
        self._info = info
        self._first = first

    def __call__(self, data: bytes) -> None:
        refinement = Refinement.from_bytes(_checked(data))
        model = ClassicModel(self._info) if self._info.profile == "classic" else Model(self._info)
        if refinement.generator is not Generator.COARSE:
            for one in self._first:
                model.apply(one)
        model.apply(refinement)


def _sphere() -> tuple[m.ScanInfo, Sequence[Refinement]]:
    """As the golden vectors begin."""
    coarse = RANGE.coarse_width, RANGE.coarse_height, TEXTURE.coarse_width, TEXTURE.coarse_height
    info = m.ScanInfo("golden", 64, 136, 64, 136, *coarse, 0.01, 1.0, 0.0, 0.0, geometry="sphere")
    steps = encode_range(np.ones((17, 8), np.uint16), RangeCodec.RAW)
    texels = encode_texture(np.zeros((17, 8, 3), np.uint8), TextureCodec.HTJ2K, 255)
    return info, (
        Refinement(Generator.COARSE, Channel.RANGE, 1, 0, 0, RangeCodec.RAW, 1, 136, steps),
        Refinement(Generator.COARSE, Channel.TEXTURE, 1, 1, 0, TextureCodec.HTJ2K, 255, 136, texels),
    )


def _round_a_pole() -> Refinement:
    """Texture in one image."""
    parameters = Parameters(4, 0, 0, 4, 3, polar=True)
    strips = select_strips(build_strips(TEXTURE, parameters), ChannelHoldings.coarse(TEXTURE), texture_rank(40))
    (shape,) = image_shapes(strips, TextureCodec.HTJ2K)
    payload = encode_texture(np.full((*shape, 3), 90, np.uint8), TextureCodec.HTJ2K, 40)
    return Refinement(
        Generator.FOVEA, Channel.TEXTURE, 1, 2, 1, TextureCodec.HTJ2K, 40, math.prod(shape), payload, b"", parameters
    )


# -- payloads ----------------------------------------------------------------------------------------------------------

SHAPE = (24, 40)


def _of_codecs() -> Iterable[Target]:
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]]
    steps = (1000 + 3 * rows + columns).astype(np.uint16)
    image = np.stack([rows * 5, columns * 4, rows + columns], axis=-1).astype(np.uint8)
    for codec in RangeCodec:
        coded = encode_range(steps, codec)
        yield Target(f"range-{codec.name.lower()}", (coded,), partial(decode_range, codec=codec, shape=SHAPE))
    for texture, quality in ((TextureCodec.JPEG, 30), (TextureCodec.HTJ2K, 40), (TextureCodec.HTJ2K, 255)):
        coded = encode_texture(image, texture, quality)
        name = f"texture-{texture.name.lower()}-{quality}"
        yield Target(name, (coded,), partial(decode_texture, codec=texture, quality=quality, shape=SHAPE))
    yield Target("mask", (encode_mask(steps > 1050),), lambda data: decode_mask(data, SHAPE))


# -- files -------------------------------------------------------------------------------------------------------------


def _of_files(folder: Path) -> Iterable[Target]:
    grid = vase(holes=True)
    for suffix, name in ((".npz", "npz"), (".glb", "glb"), (".ply", "ply"), (".stl", "stl")):
        file = io.BytesIO()
        writer_of(suffix)(grid, file)
        yield Target(name, (file.getvalue(),), _FileOf(folder / f"fuzzed{suffix}"))
    yield Target("npz-upload", (_written(grid),), lambda data: read_native(io.BytesIO(data)))
    yield Target("npz-array", (_npy_of(grid.range_steps),), _read_member)
    obj = b"mtllib m\nv 1 0 0\nv 0 1 0\nv 0 0 1\nv 1 1 1\nvt 0 0\nvn 0 0 1\nf 1/1/1 2/1/1 3/1/1\nf 1 2 4\nf -1 -2 -3"
    yield Target("obj", (obj,), _FileOf(folder / "fuzzed.obj"))
    off = b"OFF\n4 2 0\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n3 0 1 2\n3 0 1 3\n"
    yield Target("off", (off,), _FileOf(folder / "fuzzed.off"))
    yield Target("echo", (echo(),), _FileOf(folder / "fuzzed.ech"))


def _written(grid: object) -> bytes:
    file = io.BytesIO()
    writer_of(".npz")(grid, file)  # type: ignore[arg-type]  # a grid, as its maker says
    return file.getvalue()


def _npy_of(array: StepArray) -> bytes:
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


def _read_member(data: bytes) -> None:
    """In an archive whose checksums are right."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for name in ("depth_u16", "texture", "z_min_mm", "name"):
            archive.writestr(f"{name}.npy", data)
    file.seek(0)
    read_native(file)


class _FileOf:
    """Reads a file of these bytes."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def __call__(self, data: bytes) -> None:
        self._path.write_bytes(data)
        read_scan(self._path, options=SMALL)


# -- what a node reads -------------------------------------------------------------------------------------------------


def _of_the_node(folder: Path) -> Iterable[Target]:
    settings_file = folder / "node.toml"

    def read_settings(data: bytes) -> None:
        settings_file.write_bytes(data)
        load_config(settings_file)

    ours = (Path(__file__).parents[2] / "systemd/node.toml").read_bytes()
    yield Target("config", (SETTINGS, b"[log]\nunknown = 1", ours), read_settings)
    yield Target("pairing", PAIRING, _pair, (FoveascanError, msgspec.DecodeError, UnicodeError))
    yield Target("sidecar-changes", (b'{"name":"x","notes":"y"}',), decode_changes, (ValueError,))
    header = next(message for message, _ in TABLE if isinstance(message, SweepHeader))
    opening = encode_record(encode_opening(DeviceInfo("A7", 5, 1000, 100), header, 1.0))
    column = encode_record(encode_entry(RangeColumn(7, 0, 1, 0, 1, 1, bytes(2 * SPEC.height))))
    yield Target("journal", (opening + column * 3,), lambda data: survey_journal("0" * 16, data))
    who = b'"name":"x","role":"view"'
    token = b'{%s,"digest":"%s","created_unix_s":1}' % (who, b"ab" * 32)
    code = b'{%s,"key":"%s","expires_unix_s":9e9}' % (who, b"cd" * 32)
    yield Target("access", (b'{"format":1,"tokens":[%s],"codes":[%s]}' % (token, code),), _AccessOf(folder))
    yield Target("backup", (_backup(folder),), _RestoreOf(folder))


def _pair(data: bytes) -> None:
    """As the node does with a body, and a person with a code."""
    for kind in (pairing.PairRequest, pairing.Paired):
        try:
            msgspec.json.decode(data, type=kind)
        except (msgspec.DecodeError, UnicodeError):
            continue
    pairing.parse_code(data.decode())


class _AccessOf:
    def __init__(self, folder: Path) -> None:
        self._folder = access_folder(folder)

    def __call__(self, data: bytes) -> None:
        (self._folder / "access.json").write_bytes(data)
        Access(self._folder).redeem(lambda key: False, 1.0)


def _backup(folder: Path) -> bytes:
    place = folder / "backed-up"
    library = Library(place)
    scan = library.add(vase(), About(1.0))
    library.close()
    backup(place, [scan.id], folder / "backup.tar")
    return (folder / "backup.tar").read_bytes()


class _RestoreOf:
    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._count = 0

    def __call__(self, data: bytes) -> None:
        self._count += 1
        (self._folder / "fuzzed.tar").write_bytes(data)
        place = self._folder / f"restored-{self._count}"
        place.mkdir()
        try:
            restore(self._folder / "fuzzed.tar", place)
        finally:
            shutil.rmtree(place)


