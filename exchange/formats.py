"""Which suffix is which format: the one place to ask when a scan is to become a file, or a file a scan."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, BinaryIO

from exchange.errors import ExchangeError
from protocol.grid import Geometry, Grid, ImageArray

if TYPE_CHECKING:
    from exchange.cast import Mesh
    from exchange.mesh_file import Placing
    from exchange.native import Scanned
    from exchange.sweeps import Sweep

Writer = Callable[[Grid, BinaryIO], None]
Size = tuple[int, int, int, int]  # W, H, Wt, Ht

MEDIA_TYPES: Mapping[str, str] = MappingProxyType(
    {
        ".glb": "model/gltf-binary",
        ".ply": "application/octet-stream",
        ".obj.zip": "application/zip",
        ".stl": "model/stl",
        ".npz": "application/zip",
    }
)
NOT_CLOSED = "seen from its axis: it is open, or too much of it is hidden from every centre"
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".ppm", ".bmp")
SIZES: Mapping[str, Size] = MappingProxyType(
    {
        "S": (360, 100, 1024, 256),
        "M": (1440, 1024, 4096, 2048),
        "L": (4096, 2048, 8192, 4096),
    }
)


@dataclass(frozen=True, slots=True)
class ReadOptions:
    """What a file does not say itself.

    size : W, H, Wt, Ht a mesh is cast on.  placing : of one; None: as its format demands.  theta0_rad : see fit_spec.
    geometry : as what it is wanted; None: a grid as it is, a mesh as a sphere if it is closed and hides little of
    itself from its centre, else as a cylinder.  caps : make up lids over a cylinder's open ends (exchange.closing).
    centre_mm : height of a sphere's centre; None: chosen.  sweeps : others of the object, for what a cylinder does not
    see.  Raises ExchangeError for what only a sphere has.
    """

    size: Size = SIZES["M"]
    placing: Placing | None = None
    theta0_rad: float = 0.0
    geometry: Geometry | None = None
    caps: bool = False
    centre_mm: float | None = None
    sweeps: tuple[Sweep, ...] = ()

    def __post_init__(self) -> None:
        if self.geometry != "sphere" and (self.caps or self.centre_mm is not None or self.sweeps):
            raise ExchangeError("caps, a centre and other sweeps go with a sphere: --geometry sphere")


def suffix_of(name: str | Path) -> str:
    """The suffix of a format we write. Raises ExchangeError for any other."""
    text = Path(name).name.lower()
    for suffix in MEDIA_TYPES:
        if text.endswith(suffix):
            return suffix
    raise ExchangeError(f"{name}: cannot tell its format; end it in {', '.join(MEDIA_TYPES)}")


def writer_of(suffix: str) -> Writer:
    """What writes the format of a suffix that `suffix_of` gave."""
    match suffix:
        case ".glb":
            from exchange.glb import write_glb as write
        case ".ply":
            from exchange.ply import write_ply as write
        case ".obj.zip":
            from exchange.obj import write_obj_zip as write
        case ".stl":
            from exchange.stl import write_stl as write
        case _:
            from exchange.native import write_native as write
    return write


def read_scan(
    path: Path,
    texture_path: Path | None = None,
    options: ReadOptions = ReadOptions(),
    progress: Callable[[float], object] = lambda share: None,
) -> Scanned:
    """A scan from a grid (.npz), an Echo file (known by its content), a mesh or points.

    texture_path : its colour; an Echo file takes the image of its own name beside it.  progress : share done, 0..1.
    Raises ExchangeError that names the file and the field at fault, OSError for a file that cannot be opened.
    """
    try:
        found = _read(path, texture_path, options, progress)
    except ExchangeError as problem:
        raise problem if str(path) in str(problem) else ExchangeError(f"{path}: {problem}") from problem
    return found if found.name else found._replace(name=path.stem)


def _read(
    path: Path, texture_path: Path | None, options: ReadOptions, progress: Callable[[float], object]
) -> Scanned:
    from exchange.echo import HEADER_BYTES_MAX, is_echo, read_echo
    from exchange.native import Scanned, read_native

    with open(path, "rb") as file:
        head = file.read(HEADER_BYTES_MAX)
        file.seek(0)
        if path.suffix.lower() == ".npz":
            return as_wanted(read_native(file, _image(texture_path)), options, progress)
        if is_echo(head):
            grid = read_echo(file, _image(texture_path or _image_beside(path)))
            return as_wanted(Scanned("", grid), options, progress)
    return _read_mesh(path, _image(texture_path), options, progress)


def as_wanted(
    found: Scanned, options: ReadOptions, progress: Callable[[float], object] = lambda share: None
) -> Scanned:
    """A grid in the geometry that is wanted, itself where it has it already. Raises ExchangeError where it has none."""
    from exchange.closing import close_scan
    from exchange.unrolling import unroll

    if options.geometry in (None, found.grid.spec.geometry):
        if options.sweeps or options.caps:
            raise ExchangeError(f"scan: is a {found.grid.spec.geometry} already; caps and sweeps complete a cylinder")
        return found
    if options.geometry == "cylinder":
        return found._replace(grid=unroll(found.grid), note=joined(found.note, "a sphere as its axis sees it"))
    repaired = f"{len(found.grid.repairs)} samples of it were repaired" if found.grid.repairs.size else ""
    closed, said = close_scan(
        found.grid, options.sweeps, caps=options.caps, centre_mm=options.centre_mm, progress=progress
    )
    return found._replace(grid=closed, note=joined(found.note, str(said), repaired))


def read_surface(path: Path, placing: Placing | None = None) -> Grid | Mesh:
    """A file for a Sweep: a cylindrical grid, an Echo file, or a mesh, centred on the axis. Raises as `read_scan`."""
    from exchange.mesh_file import SUFFIXES, Placing, read_mesh
    from exchange.points import Points

    if path.suffix.lower() == ".zip":
        raise ExchangeError("an archive: unpack it, and import the model.obj or other mesh that is in it")
    if path.suffix.lower() not in SUFFIXES:
        return read_scan(path).grid
    given = placing or Placing()
    found = read_mesh(path, Placing(given.up, given.unit_mm, centred=True))
    if isinstance(found, Points):
        raise ExchangeError(f"{path}: points without triangles show no surface")
    return found


def joined(found: str, *notes: str) -> str:
    """What a scan came with, and our notes behind it; where that is too long, the older ones lose their beginning."""
    from exchange.native import NOTE_MAX

    text = ". ".join(filter(None, (found, *(note[:1].upper() + note[1:] for note in notes))))
    return text if len(text) <= NOTE_MAX else f"... {text[4 - NOTE_MAX :]}"


def _read_mesh(
    path: Path, texture: ImageArray | None, options: ReadOptions, progress: Callable[[float], object]
) -> Scanned:
    from exchange.cast import cast_mesh, fit_spec
    from exchange.mesh_file import SUFFIXES, Placing, read_mesh
    from exchange.native import Scanned
    from exchange.points import Points, bin_points
    from exchange.star import close_mesh, star_centre

    if path.suffix.lower() == ".zip":
        raise ExchangeError("an archive: unpack it, and import the model.obj or other mesh that is in it")
    if path.suffix.lower() not in SUFFIXES:
        raise ExchangeError(f"no scan: expected an Echo file, .npz, {', '.join(SUFFIXES)}")
    if options.sweeps:
        raise ExchangeError("mesh: sweeps complete a cylindrical scan, not a mesh")
    found = read_mesh(path, options.placing or Placing(), texture)
    if isinstance(found, Points):
        if options.geometry == "sphere":
            raise ExchangeError("points are not closed: a sphere is made of triangles")
        size = *options.size[:2], *options.size[:2]  # a point colours one texel: more of them would be gaps
        return Scanned("", bin_points(found, fit_spec(found.positions, size, options.theta0_rad)))
    centre_mm = star_centre(found) if options.geometry is None else options.centre_mm
    if options.geometry == "sphere" or centre_mm is not None:
        grid, seen = close_mesh(found, options.size, options.theta0_rad, centre_mm, progress)
        return Scanned("", grid, str(seen))
    said = NOT_CLOSED if options.geometry is None else ""
    return Scanned("", cast_mesh(found, fit_spec(found.corners, options.size, options.theta0_rad), progress), said)


def _image(path: Path | None) -> ImageArray | None:
    from exchange.image import read_image

    return None if path is None else read_image(path)


def _image_beside(path: Path) -> Path | None:
    beside = (path.with_suffix(suffix) for suffix in IMAGE_SUFFIXES)
    return next((image for image in beside if image.is_file()), None)
