"""Parsers of what node and clients keep on disk, and of what they are told in passing: answers, headers, names."""

from __future__ import annotations

import asyncio
import datetime as dt
import io
import os
import urllib.parse
import zlib
from collections.abc import Callable, Iterable
from contextlib import closing
from pathlib import Path

import msgspec
import numpy as np
from aiohttp import web
from aiohttp.test_utils import make_mocked_request

from client import credentials
from client.discovery import _printable
from client.login import logged_in
from client.model import Model
from client.rest import reply
from client.session import error_envelope_mm
from client.shared import refinements_in
from client.trust import certificate_pin
from drivers.address import check_address
from exchange.image import encode_png, read_image
from node import auth, last_used, library_routes, proxy, shared
from node.attempts import place_of_address
from node.audit import NODE, begins_a_time, entry, read_trail
from node.axes import FILE as AXES
from node.axes import Axes
from node.bodies import AxisWanted, Derivation, FoveaQuery, NewCode
from node.identity import node_identity
from node.library import About, Library, survey
from node.library_folder import MARK_FILE, check_format
from node.rest import decoded, query_of
from node.scan_folder import read_grid
from node.sidecar import Changes, read_sidecar
from node.tls import _read_key, read_certificate, renew_own
from node.trail import Trail
from protocol import messages as m
from protocol.errors import FoveascanError
from protocol.lattice import Channel
from tests.client.scripted_node import Planner, synthetic_grid
from tests.exchange.grids import vase
from tests.fuzz.target import Target
from tests.node.round_bodies import KNOWN

REFUSED = (FoveascanError, web.HTTPException)
EMPTY = make_mocked_request("POST", "/v1/stream")  # its copies take a twentieth of the time of another
ADDRESSES = (b"usb:1209:5ca1:A7", b"serial:1209:5ca1", b"tcp:[::1]:7400", b"tcp:scanner:7400", b"/dev/ttyACM0")


def of_disks(folder: Path) -> Iterable[Target]:
    """What a node keeps, and what a client does. folder : for the files of it."""
    place = folder / "kept"
    with closing(Library(place)) as library:
        scan = library.add(vase(), About(1.0, name="x")).id
        library.annotate(scan, Changes(name="y", notes="z"), "me")
    spec = survey(place)[0][scan].spec
    yield _file("scan-record", place / scan / "scan.json", lambda: survey(place))
    yield _file("sidecar", place / scan / "sidecar.json", lambda: read_sidecar(place / scan))
    yield _file("samples", place / scan / "range.npy", lambda: read_grid(place / scan, spec))
    (place / scan / "repairs.npy").write_bytes(_npy(np.array([[1, 2, 3]], np.int32)))
    yield _file("repairs", place / scan / "repairs.npy", lambda: read_grid(place / scan, spec))
    yield _file("library-mark", place / MARK_FILE, lambda: check_format(place))
    Axes(place).keep(KNOWN)
    yield _file("axes", place / AXES, lambda: Axes(place))
    node_identity(place)
    yield _file("identity", place / "node-id", lambda: node_identity(place))
    trail = Trail(folder / "audit", "audit", 1 << 20)
    (folder / "audit").mkdir()
    trail.append([msgspec.json.encode(entry("seen", NODE, scan=scan))])
    yield _file("audit-log", folder / "audit" / "audit.jsonl", lambda: list(read_trail(trail, scan="0")))
    yield from _certificates(folder / "access")
    (folder / last_used.FILE).write_bytes(msgspec.json.encode({"0" * 64: 1.5}))
    yield _file("last-used", folder / last_used.FILE, lambda: last_used.LastUsed(folder))
    yield _file("image", folder / "image.png", lambda: read_image(folder / "image.png"), encode_png(vase().texture))
    kept = credentials._File((credentials.Credential("n1", "https://n:1", "me", "view", "secret", "ab" * 32),))
    yield Target("credentials", (msgspec.json.encode(kept),), _CredentialsIn(folder / "config"))


def of_hearsay() -> Iterable[Target]:
    """What a node is asked by, and a client is answered."""
    yield Target("address", ADDRESSES, lambda data: check_address(_text(data)), (ValueError,))
    yield Target("peer", (b"::ffff:10.0.0.1", b"fe80::1%eth0", b"10.0.0.1"), lambda data: place_of_address(_text(data)))
    yield Target("announcement", (b"name=room 2",), _printable)
    yield Target("url", (b"https://[::1]:7345", b"http://scanner.example:7345/"), _log_in)
    yield Target("fingerprint", (b"AB:" * 31 + b"CD",), lambda data: certificate_pin(_text(data)))
    yield Target("answer", (b'{"code":"not found","message":"x"}', b"[" * 3000), lambda data: reply(404, data))
    planner = Planner(synthetic_grid())
    body = b"".join(len(part).to_bytes(4, "little") + part for part in (r.to_bytes() for r in planner.first_view()))
    yield Target("first-view", (body,), refinements_in)
    blocks = planner.shapes[Channel.RANGE].blocks
    yield Target("envelope", (_deflated(bytes(2 * blocks[0] * blocks[1])),), _EnvelopeOf(planner))
    derivation = msgspec.json.encode({"geometry": "sphere", "caps": True, "top": "latest", "tipDeg": 80})
    yield Target("derivation", (derivation,), lambda data: decoded(data, Derivation), REFUSED)
    calibration = b'{"scan":"latest","diameterMm":80}'
    yield Target("calibration", (calibration,), lambda data: decoded(data, AxisWanted), REFUSED)
    yield Target("code", (b'{"name":"x","role":"view"}',), _decode_code, REFUSED)
    yield Target("if-match", (b'"3"',), _asked({"If-Match": ""}, library_routes._revision), REFUSED)
    yield Target("bearer", (b"Bearer abc",), _asked({"Authorization": ""}, auth._token_shown), REFUSED)
    yield Target("cookie", (f"a=b; {auth.COOKIE}=c".encode(),), _asked({"Cookie": ""}, auth._token_shown), REFUSED)
    subprotocol = f"foveascan.v1, {auth.SUBPROTOCOL}abc".encode()
    yield Target("subprotocol", (subprotocol,), _asked({"Sec-WebSocket-Protocol": ""}, auth._token_shown), REFUSED)
    yield Target("origin", (b"https://n:1",), _asked({"Origin": "", "Cookie": "a=b"}, auth.Auth(None)._foreign))
    yield Target("host", (b"localhost:1", b"[::1]:80"), _asked({"Host": ""}, auth.Auth(None)._foreign))
    yield Target("forwarded", (b"10.0.0.1, ::1", b"1.2.3.4"), lambda data: proxy._client([_text(data)], frozenset()))
    kept = f"/v1/scans/{'0' * 32}/fovea/00000000/2.0.0.1.1.0.0.1/-".encode()
    yield Target("original-uri", (kept,), lambda data: shared.KEPT.fullmatch(_text(data)))
    yield Target("fovea", (b"2.0.0.1.1.0.0.1", b"2.0.0.1.1.0.0.1.3.4"), _number_fovea, (ValueError,))
    look = b"u=0.5&v=0.5&max_bytes=900&texture_db=40&codec=jpeg"
    yield Target("query", (look,), _query, REFUSED)
    yield Target("time", (b"2026-11-22T08:00:00.000Z",), lambda data: begins_a_time(_text(data)))


def _text(data: bytes) -> str:
    return data.decode(errors="replace")


def _file(name: str, path: Path, read: Callable[[], object], seed: bytes | None = None) -> Target:
    """A parser of one file, which keeps the name and place that it has."""

    def parse(data: bytes) -> None:
        path.write_bytes(data)
        read()

    return Target(name, (path.read_bytes() if seed is None else seed,), parse)


def _npy(array: np.ndarray[tuple[int, ...], np.dtype[np.int32]]) -> bytes:
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


def _certificates(folder: Path) -> Iterable[Target]:
    folder.mkdir(exist_ok=True)
    renew_own(folder, "n1", "127.0.0.1", dt.datetime.now(dt.UTC))
    pem = (folder / "certificate.pem").read_bytes()
    yield _file("certificate", folder / "other.pem", lambda: read_certificate(folder / "other.pem"), pem)
    yield _file("key", folder / "key.pem", lambda: _read_key(folder / "key.pem"), pem)


class _CredentialsIn:
    """Reads them from where this user's would be."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        (folder / "foveascan").mkdir(parents=True)

    def __call__(self, data: bytes) -> None:
        before = os.environ.get("XDG_CONFIG_HOME")
        os.environ["XDG_CONFIG_HOME"] = str(self._folder)
        try:
            credentials.credentials_path().write_bytes(data)
            credentials.read_credentials()
        finally:
            del os.environ["XDG_CONFIG_HOME"]
            if before is not None:
                os.environ["XDG_CONFIG_HOME"] = before


def _log_in(data: bytes) -> None:
    async def enter() -> None:
        async with logged_in(_text(data), fingerprint="ab" * 32):
            pass

    asyncio.run(enter())


def _deflated(data: bytes) -> bytes:
    packer = zlib.compressobj(wbits=-15)
    return packer.compress(data) + packer.flush()


class _EnvelopeOf:
    def __init__(self, planner: Planner) -> None:
        self._model = Model(planner.info)
        for refinement in planner.first_view():
            self._model.apply(refinement)

    def __call__(self, data: bytes) -> None:
        error_envelope_mm(m.Enveloped(1, 1, data), self._model)


def _decode_code(data: bytes) -> object:
    return decoded(data, NewCode)


def _asked(headers: dict[str, str], read: Callable[[web.Request], object]) -> Callable[[bytes], object]:
    """A parser of the header of a request that is empty here; what no request can hold is left out."""

    def parse(data: bytes) -> object:
        text = "".join(char for char in _text(data) if char not in "\r\n\0")
        return read(EMPTY.clone(headers={name: value or text for name, value in headers.items()}))

    return parse


def _number_fovea(data: bytes) -> object:
    return shared._numbers(_text(data), shared.RANGE_NUMBERS)


def _query(data: bytes) -> object:
    asked = EMPTY.clone(rel_url=f"/?{urllib.parse.quote(data, safe='=&%+.')}")
    return shared._look(query_of(asked, FoveaQuery))
