"""One scan on disk: a folder whose files are written once and never changed, except for the sidecar.

    <library>/<scan id>/range.npy      (H, W) uint16 steps, little-endian, 0 = void
                        texture.npy    (Ht, Wt, 3) uint8 RGB
                        repairs.npy    (n, 3) int32, as Grid.repairs; missing where there are none
                        scan.json      format, id, sequence, geometry, where it came from
                        sidecar.json   what people say of it (node.sidecar); missing until somebody does

The id is the hash of geometry, samples and repairs, so it also tells whether a file has rotted.
"""

from __future__ import annotations

import hashlib
import math
import os
import re
import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from tokenize import TokenError
from typing import Annotated, Any

import msgspec
import numpy as np
from numpy.lib.format import open_memmap
from numpy.typing import NDArray

from exchange.native import NOTE_MAX
from node.durable import decode_kept, read_bounded, read_through, sync_folder, write_whole
from node.scan_quality import ScanQuality
from protocol.errors import LibraryError
from protocol.grid import Grid, GridSpec, ImageArray, RepairArray, StepArray, no_repairs

FORMAT = 1
RECORD_BYTES_MAX = 65536
ARRAY_HEADER_BYTES_MAX = 4096
TEXT_MAX = 200
NAMED_MAX = 3
MADE_FROM_MAX = 8
SCAN_ID = re.compile("[0-9a-f]{32}")
INCOMING = ".incoming-"
RANGE_FILE, TEXTURE_FILE, REPAIRS_FILE, RECORD_FILE = "range.npy", "texture.npy", "repairs.npy", "scan.json"
REPAIR_BYTES = 12


@dataclass(frozen=True, slots=True)
class About:
    """Where a scan came from. Nothing of the patient: this is listed freely.

    created_unix_s : the node's clock, for people; it orders nothing.  source : "sweep", "import" or "derived".
    name : what to call it, at most 200 characters.  quality : what the sweep was worth, None of a scan that came as a
    file, or from a version that did not keep it.  note : how it was made where it was not measured so, and what of it
    is made up; at most 1000 characters.  made_from : the ids of the scans it was made of.  scanner, settings : the
    serial number of who swept it, and the number of its calibration then; "" where that is not known.
    Raises ValueError when out of bounds.
    """

    created_unix_s: float
    source: str = "sweep"
    name: str = ""
    quality: ScanQuality | None = None
    note: str = ""
    made_from: tuple[str, ...] = ()
    scanner: str = ""
    settings: int = 0

    def __post_init__(self) -> None:
        if not math.isfinite(self.created_unix_s):
            raise ValueError(f"created_unix_s must be finite, got {self.created_unix_s}")
        if len(self.note) > NOTE_MAX or len(self.made_from) > MADE_FROM_MAX:
            raise ValueError(f"a note of {len(self.note)} characters, or {len(self.made_from)} scans it was made of")
        for text in (self.source, self.name, self.scanner, *self.made_from):
            if len(text) > TEXT_MAX:
                raise ValueError(f"a text of {len(text)} characters, at most {TEXT_MAX} are kept")


@dataclass(frozen=True, slots=True)
class Problem:
    """Something in the library's folder that is not as it should be: its name there, and what is wrong."""

    name: str
    reason: str


def name_problems(problems: Sequence[Problem]) -> str:
    """The first few of them, in words for people."""
    return "; ".join(f"{problem.name}: {problem.reason}" for problem in problems[:NAMED_MAX])


class Record(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """scan.json. sequence : grows with every scan of a library, and orders them.  repairs : rows of repairs.npy."""

    format: int
    id: str
    sequence: int
    spec: GridSpec
    about: About
    repairs: Annotated[int, msgspec.Meta(ge=0)] = 0


class _Version(msgspec.Struct, frozen=True):
    """The one field of scan.json that every version has."""

    format: int


def content_id(grid: Grid) -> str:
    """Name of a grid: 32 hexadecimal digits, the first half of SHA-256 over its geometry, samples and repairs."""
    digest = hashlib.sha256(b"foveascan scan 1\n")
    digest.update(_spec_json(grid.spec))
    digest.update(np.ascontiguousarray(grid.range_steps, "<u2").data)
    digest.update(np.ascontiguousarray(grid.texture).data)
    digest.update(np.ascontiguousarray(grid.repairs, "<i4").data)
    return digest.hexdigest()[:32]


def _spec_json(spec: GridSpec) -> bytes:
    """A geometry as its hash knows it: a cylinder is not named, as it was the only one once."""
    fields = asdict(spec)
    if spec.geometry == "cylinder":
        del fields["geometry"]
    return msgspec.json.encode(fields)


def read_record(folder: Path) -> Record:
    """A scan's record, checked against the sizes of its files: reads no samples. Raises LibraryError."""
    try:
        if not SCAN_ID.fullmatch(folder.name) or not folder.is_dir():
            raise LibraryError("not a scan")
        record = decode_record(read_bounded(folder / RECORD_FILE, RECORD_BYTES_MAX))
    except OSError as error:
        raise LibraryError(f"its {RECORD_FILE} cannot be read: {error.strerror}") from error
    if record.id != folder.name:
        raise LibraryError(f"its {RECORD_FILE} belongs to scan {record.id[:40]!r}")
    _check_sizes(folder, record)
    return record


def decode_record(data: bytes) -> Record:
    """The content of scan.json. Raises LibraryError."""
    what = f"its {RECORD_FILE}"
    if decode_kept(data, _Version, what).format != FORMAT:
        raise LibraryError("written in a format that this version does not know")
    return decode_kept(data, Record, what)


def read_grid(folder: Path, spec: GridSpec) -> Grid:
    """A scan's samples, mapped read-only. Raises LibraryError when they are not what its geometry says."""
    try:
        range_steps, texture = (_mapped(folder / name) for name in (RANGE_FILE, TEXTURE_FILE))
        return Grid(spec, range_steps, texture, _read_repairs(folder / REPAIRS_FILE))
    except (OSError, ValueError, EOFError, OverflowError, TokenError, SyntaxError) as error:  # headers are Python
        raise LibraryError(f"its samples cannot be read: {error}") from error


def _mapped(path: Path) -> NDArray[Any]:
    """An array in a file, read-only; as a plain array, since each part taken of a memmap costs a memmap's making.

    Raises what `read_grid` translates.
    """
    return np.asarray(open_memmap(path, mode="r"))


def _read_repairs(path: Path) -> RepairArray:
    """Raises what `read_grid` translates."""
    if not path.exists():
        return no_repairs()
    repairs: RepairArray = open_memmap(path, mode="r")
    return repairs


def read_sound_grid(folder: Path, spec: GridSpec) -> Grid:
    """A scan's samples, mapped, and the same as when they were kept. Raises LibraryError."""
    grid = read_grid(folder, spec)
    for name in (RANGE_FILE, TEXTURE_FILE, REPAIRS_FILE):
        _read_through(folder / name)
    if content_id(grid) != folder.name:
        raise LibraryError("its samples are not what they were when it was kept")
    return grid


def _read_through(path: Path) -> None:
    try:
        with open(path, "rb") as file:
            read_through(file.fileno())
    except FileNotFoundError:
        return  # there are no repairs
    except OSError as error:
        raise LibraryError(f"its {path.name} cannot be read: {error.strerror}") from error


def write_scan(library: Path, record: Record, grid: Grid) -> None:
    """Write a scan beside the others under a name that is no scan's, then rename it: it appears whole.

    Raises OSError; then nothing of it is left.
    """
    incoming = Path(tempfile.mkdtemp(prefix=INCOMING, dir=library))
    try:
        _write_array(incoming / RANGE_FILE, np.ascontiguousarray(grid.range_steps, "<u2"))
        _write_array(incoming / TEXTURE_FILE, np.ascontiguousarray(grid.texture))
        if grid.repairs.size:
            _write_array(incoming / REPAIRS_FILE, np.ascontiguousarray(grid.repairs, "<i4"))
        write_record(incoming, record)
        os.rename(incoming, library / record.id)
        sync_folder(library)
    except BaseException:
        shutil.rmtree(incoming, ignore_errors=True)
        raise


def write_record(folder: Path, record: Record) -> None:
    """Put scan.json into a folder, or exchange the one that is there, in one step. Raises OSError."""
    write_whole(folder / RECORD_FILE, msgspec.json.format(msgspec.json.encode(record)))


def _check_sizes(folder: Path, record: Record) -> None:
    """A listing must not read samples: the sizes of their files show what was cut or lost."""
    spec = record.spec
    sizes = {RANGE_FILE: 2 * spec.height * spec.width, TEXTURE_FILE: 3 * spec.texture_height * spec.texture_width}
    if record.repairs:
        sizes[REPAIRS_FILE] = REPAIR_BYTES * record.repairs
    for name, size_bytes in sizes.items():
        try:
            header_bytes = os.stat(folder / name).st_size - size_bytes
        except OSError as error:
            raise LibraryError(f"its {name} cannot be read: {error.strerror}") from error
        if not 0 < header_bytes <= ARRAY_HEADER_BYTES_MAX:
            raise LibraryError(f"its {name} has the wrong size")


def _write_array(path: Path, array: StepArray | ImageArray | RepairArray) -> None:
    with open(path, "xb") as file:
        np.save(file, array, allow_pickle=False)
        file.flush()
        os.fsync(file.fileno())
