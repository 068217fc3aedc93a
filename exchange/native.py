"""The grid itself as .npz: every sample, bit for bit.

    depth_u16   (H, W) uint16 steps, 0 = void      texture  (Ht, Wt, 3) uint8 RGB; may stand beside as an image
    scale_mm    millimetres of a step              name     what to call it; optional
    z_min_mm, z_max_mm  bottom edge of the last row, top edge of row 0
    theta0_rad  angle of the left edge of column 0
    pitch_mm    height of a row, exactly; optional: (z_max_mm - z_min_mm) / H, which may be off by a rounding
    repairs     (n, 3) int32, range cells that are not as they were measured, row by row: row, column, steps measured
                there (0 = nothing); optional
    note        how the scan was made, where its geometry is not as it was measured; optional
    geometry    "sphere" for directions from a centre at z_max_mm on the axis, rings of depth thinned; optional:
                "cylinder"

The keys are those of make_cyl.py. What a member says of its shape is checked before anything is allocated.
"""

from __future__ import annotations

import errno
import math
import zipfile
import zlib
from tokenize import TokenError
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from exchange.errors import ExchangeError
from protocol.grid import HEIGHT_MAX, WIDTH_MAX, Geometry, Grid, GridSpec, ImageArray, RepairArray, no_repairs
from protocol.rings import thin_rings, thin_texture

NAME_MAX = 200
NOTE_MAX = 1000
MEMBERS_MAX = 64
ARRAY_BYTES_MAX = WIDTH_MAX * HEIGHT_MAX * 3
PITCH_TOLERANCE = 1e-9
Shape = tuple[int, ...]


class Scanned(NamedTuple):
    """A scan as a file brings it. name : "" where it has none.  note : what is to be known of how it was made."""

    name: str
    grid: Grid
    note: str = ""


def write_native(grid: Grid, file: BinaryIO, name: str = "", note: str = "") -> None:
    """Write a grid so that `read_native` gives the very same one."""
    spec = grid.spec
    optional: dict[str, Any] = {} if spec.geometry == "cylinder" else {"geometry": np.str_(spec.geometry)}
    if grid.repairs.size:
        optional["repairs"] = np.asarray(grid.repairs, "<i4")
    if note:
        optional["note"] = np.str_(note[:NOTE_MAX])
    np.savez(
        file,
        depth_u16=np.asarray(grid.range_steps, "<u2"),
        texture=grid.texture,
        scale_mm=np.float64(spec.step_mm),
        z_min_mm=np.float64(spec.z_max_mm - spec.height * spec.pitch_mm),
        z_max_mm=np.float64(spec.z_max_mm),
        theta0_rad=np.float64(spec.theta0_rad),
        pitch_mm=np.float64(spec.pitch_mm),
        name=np.str_(name[:NAME_MAX]),
        **optional,
    )


def read_native(
    file: BinaryIO, texture: ImageArray | None = None, array_bytes_max: int = ARRAY_BYTES_MAX
) -> Scanned:
    """A grid, with its name and note.

    texture : taken instead of the file's own.    array_bytes_max : bound on each array, checked before it is read.
    Raises ExchangeError that names the member at fault.
    """
    try:
        with zipfile.ZipFile(file) as archive:
            return _read(_Members(archive, array_bytes_max), texture)
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, ValueError) as problem:
        raise ExchangeError("is no .npz file, or damaged: copy or export it anew") from problem
    except OSError as problem:
        if problem.errno != errno.EINVAL:  # which a directory of made-up offsets earns, where it seeks before the file
            raise
        raise ExchangeError("no .npz grid: it names places outside itself") from problem


class _Members:
    """The arrays in an archive, each bounded before it is read."""

    def __init__(self, archive: zipfile.ZipFile, array_bytes_max: int) -> None:
        self._archive = archive
        self._bytes_max = array_bytes_max
        self._names = {member.filename for member in archive.infolist()}
        if len(archive.infolist()) > MEMBERS_MAX:
            raise ExchangeError(f"no .npz grid: {len(archive.infolist())} members, at most {MEMBERS_MAX}")

    def __contains__(self, key: str) -> bool:
        return f"{key}.npy" in self._names

    def array(self, key: str, dimensions: int, *kinds: type[Any]) -> NDArray[Any]:
        if key not in self:
            raise ExchangeError(f"{key}: missing")
        with self._archive.open(f"{key}.npy") as member:
            try:
                shape, fortran, found = _header(member)  # type: ignore[arg-type]  # numpy types a file wider than it reads
            except (ValueError, TokenError, SyntaxError) as problem:  # numpy parses it as Python
                raise ExchangeError(f"{key}: is no array in the .npy format, or damaged") from problem
            if not issubclass(found.type, kinds) or len(shape) != dimensions:
                expected = f"{dimensions} dimensions of {' or '.join(kind.__name__ for kind in kinds)}"
                raise ExchangeError(f"{key}: expected {expected}, got {found}{list(shape)}")
            size_bytes = math.prod(shape) * found.itemsize
            if size_bytes > self._bytes_max:
                raise ExchangeError(f"{key}: {size_bytes} bytes, at most {self._bytes_max}")
            data = member.read(size_bytes)
            if len(data) != size_bytes or member.read(1):
                raise ExchangeError(f"{key}: {len(data)} of {size_bytes} bytes, or more than them")
        return np.frombuffer(data, found).reshape(shape, order="F" if fortran else "C")

    def number(self, key: str) -> float:
        value = float(self.array(key, 0, np.floating, np.integer))
        if not math.isfinite(value):
            raise ExchangeError(f"{key}: must be finite, got {value}")
        return value


def _header(member: BinaryIO) -> tuple[Shape, bool, np.dtype[Any]]:
    """Shape, order and type of an array; of version 1 alone, whose headers cannot say that they are gigabytes long."""
    version = np.lib.format.read_magic(member)
    if version != (1, 0):
        raise ValueError(f"version {version} of the array format")
    header = np.lib.format.read_array_header_1_0(member)
    if min(header[0], default=0) < 0:
        raise ValueError(f"a shape of {header[0]}")
    return header


def _read(members: _Members, texture: ImageArray | None) -> Scanned:
    if texture is None and "texture" not in members:
        raise ExchangeError("texture: missing; give its image with --texture")
    depth = members.array("depth_u16", 2, np.uint16).astype(np.uint16, copy=False)
    texels: ImageArray = members.array("texture", 3, np.uint8) if texture is None else texture
    try:
        spec = _spec(members, depth.shape, texels.shape)
        if spec.geometry == "sphere" and not np.array_equal(depth, thin_rings(depth)):
            raise ExchangeError("depth_u16: a sphere's rings near the poles must be thinned (protocol/rings.py)")
        texels = thin_texture(texels) if spec.geometry == "sphere" else texels
        grid = Grid(spec, depth, texels, _repairs(members))
        return Scanned(_text(members, "name", NAME_MAX), grid, _text(members, "note", NOTE_MAX))
    except ValueError as problem:
        raise ExchangeError(str(problem)) from problem


def _spec(members: _Members, depth: Shape, texture: Shape) -> GridSpec:
    z_min_mm, z_max_mm = members.number("z_min_mm"), members.number("z_max_mm")
    pitch_mm = between_mm = (z_max_mm - z_min_mm) / max(depth[0], 1)
    if "pitch_mm" in members:
        pitch_mm = members.number("pitch_mm")
        if abs(pitch_mm - between_mm) > PITCH_TOLERANCE * max(abs(z_min_mm), abs(z_max_mm), 1):
            raise ExchangeError(f"pitch_mm: {pitch_mm} contradicts z_min_mm and z_max_mm, which give {between_mm}")
    step_mm, theta0_rad = members.number("scale_mm"), members.number("theta0_rad")
    shape = depth[1], depth[0], texture[1], texture[0]
    return GridSpec(*shape, step_mm, pitch_mm, z_max_mm, theta0_rad, _geometry(members))


def _geometry(members: _Members) -> Geometry:
    if "geometry" not in members:
        return "cylinder"
    geometry = str(members.array("geometry", 0, np.str_))
    if geometry not in ("cylinder", "sphere"):
        raise ExchangeError(f"geometry: cylinder or sphere, not {geometry[:NAME_MAX]!r}")
    return geometry  # type: ignore[return-value]  # one of the two, as just checked


def _repairs(members: _Members) -> RepairArray:
    if "repairs" not in members:
        return no_repairs()
    return members.array("repairs", 2, np.int32).astype(np.int32, copy=False)


def _text(members: _Members, key: str, length_max: int) -> str:
    if key not in members:
        return ""
    text = str(members.array(key, 0, np.str_))
    if len(text) > length_max:
        raise ExchangeError(f"{key}: {len(text)} characters, at most {length_max}")
    return text
