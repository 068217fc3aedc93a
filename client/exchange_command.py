"""The subcommands `export` and `import`: scans as files, from a node and to one."""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from client.arguments import add_closing, add_node, chosen_node, number, positive
from protocol.printable import printable

if TYPE_CHECKING:
    from client.transfer import Moved, Taken
    from exchange.formats import ReadOptions, Size
    from exchange.native import Scanned


def add_subcommands(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Offer `export` and `import`."""
    export = subparsers.add_parser("export", help="write a node's scan to a file: .glb, .ply, .obj.zip, .stl or .npz")
    export.add_argument("file", type=Path, help="what to write; the suffix is the format")
    export.add_argument("--scan", default="latest", metavar="ID", help="which scan: its id, or six digits (latest)")
    add_node(export)
    export.set_defaults(run=run_export)

    bring = subparsers.add_parser("import", help="bring a grid, a mesh or a Cyberware Echo file to a node as a scan")
    bring.add_argument("file", type=Path, help=".npz grid, mesh (.glb .gltf .obj .ply .stl .off) or Echo file")
    bring.add_argument("--texture", type=Path, metavar="IMAGE", help="its colour, where the file does not hold it")
    bring.add_argument("--name", help="what to call it (the file's own name)")
    bring.add_argument("-o", "--output", type=Path, metavar="GRID", help="write a .npz grid instead of sending it")
    _add_geometry(bring)
    _add_mesh(bring)
    add_node(bring)
    bring.set_defaults(run=run_import)


def run_export(args: argparse.Namespace) -> int:
    """Fetch the file; print its size."""
    import asyncio

    from client.export import check_target

    check_target(args.file)
    size = asyncio.run(_export(args))
    record = {"file": str(args.file), "bytes": size}
    print(json.dumps(record) if args.json else f"{args.file}: {size} bytes", flush=True)
    return 0


def run_import(args: argparse.Namespace) -> int:
    """Read the file here, whatever it takes, and send the node a plain grid; print the scan's id and its size."""
    import asyncio

    from exchange.formats import read_scan
    from exchange.mesh import extent_mm

    if args.output:
        _check_grid(args.output)
    options = _read_options(args)
    with _bar(args, "reading") as moved:
        found = read_scan(args.file, args.texture, options, lambda share: moved(round(1000 * share), 1000))
    found = found._replace(name=args.name or found.name)
    spec = found.grid.spec
    record: dict[str, object]
    if args.output:
        _write(args.output, found)
        record = {"file": str(args.output)}
        line = f"{args.output}: {spec.geometry}, {spec.width} x {spec.height}"
    else:
        sent = asyncio.run(_import(args, found))
        record = {"scan": sent.scan, "new": sent.is_new}
        line = f"scan {sent.scan}{'' if sent.is_new else ', which the node had already; it is the newest now'}"
    size_mm = extent_mm(found.grid)
    record |= {"geometry": spec.geometry, "note": found.note, "sizeMm": [round(side_mm, 3) for side_mm in size_mm]}
    large = "{:.4g} x {:.4g} mm across, {:.4g} mm high".format(*size_mm)
    lines = filter(None, (line, large, printable(found.note)))
    print(json.dumps(record) if args.json else "\n".join(lines), flush=True)
    return 0


async def _export(args: argparse.Namespace) -> int:
    from client.transfer import fetch_scan

    node = await chosen_node(args)
    with _bar(args, "fetching") as moved:
        return await fetch_scan(node, args.scan, args.file, token=args.token, moved=moved)


async def _import(args: argparse.Namespace, found: Scanned) -> Taken:
    import tempfile

    from client.transfer import send_scan
    from exchange.native import write_native

    node = await chosen_node(args)
    with tempfile.TemporaryFile() as file, _bar(args, "sending") as moved:
        write_native(found.grid, file, found.name, found.note)
        return await send_scan(node, file, token=args.token, moved=moved)


def _check_grid(path: Path) -> None:
    from exchange.errors import ExchangeError
    from exchange.whole_file import check_place

    if path.suffix.lower() != ".npz":
        raise ExchangeError(f"{path}: only .npz is written here; send it to a node and use `foveascan export`")
    check_place(path)


def _write(path: Path, found: Scanned) -> None:
    from exchange.native import write_native
    from exchange.whole_file import whole_file

    with whole_file(path) as file:
        write_native(found.grid, file, found.name, found.note)


def _read_options(args: argparse.Namespace) -> ReadOptions:
    from exchange.formats import ReadOptions, read_surface
    from exchange.mesh_file import Placing
    from exchange.sweeps import Sweep

    placing = Placing(args.up, args.unit_mm, args.centre)
    theta0_rad = math.radians(args.theta0_deg)
    given = {args.bottom: -args.tip, args.top: args.tip}  # of one that lay on its side, and saw both ends, the first
    sweeps = tuple(Sweep(read_surface(path, placing), tip_deg) for path, tip_deg in given.items() if path is not None)
    return ReadOptions(args.size, placing, theta0_rad, args.geometry, args.caps, args.centre_height, sweeps)


@contextmanager
def _bar(args: argparse.Namespace, what: str) -> Iterator[Moved]:
    """A progress bar on standard error where that is a terminal."""
    from tqdm import tqdm

    hidden = True if args.json else None
    with tqdm(desc=what, unit="B" if what != "reading" else "", unit_scale=True, leave=False, disable=hidden) as bar:

        def moved(done: int, total: int | None) -> None:
            bar.total = total
            bar.update(done - bar.n)

        yield moved


def _add_geometry(parser: argparse.ArgumentParser) -> None:
    geometry = parser.add_argument_group("geometry", "whether it is seen from an axis, or from a centre inside it")
    text = "(a grid as it is; a mesh as a sphere if it is closed); sphere says why one cannot be made"
    geometry.add_argument("--geometry", choices=("cylinder", "sphere"), help=text)
    add_closing(geometry, Path, "FILE")


def _add_mesh(parser: argparse.ArgumentParser) -> None:
    mesh = parser.add_argument_group("meshes", "what a mesh does not say itself")
    mesh.add_argument(
        "--size", type=_size, default="M", metavar="S|M|L|WxH:WtxHt", help="samples and texels (M); S is read soonest"
    )
    mesh.add_argument("--up", choices=("z", "y", "x", "-z", "-y", "-x"), help="the axis that points up (z; glTF: y)")
    mesh.add_argument("--unit-mm", type=positive, metavar="MM", help="millimetres of its unit (1; glTF: 1000)")
    mesh.add_argument("--centre", action="store_true", help="put its middle on the turntable's axis")
    mesh.add_argument("--theta0-deg", type=number, default=0.0, metavar="DEG", help="angle of the seam (0)")


def _size(text: str) -> Size:
    from exchange.formats import SIZES

    if text in SIZES:
        return SIZES[text]
    numbers = text.replace(":", "x").split("x")
    if len(numbers) != 4 or not all(number.isdigit() and 0 < len(number) <= 5 for number in numbers):
        raise argparse.ArgumentTypeError(f"expected S, M, L or WxH:WtxHt, got {text!r}")
    width, height, texture_width, texture_height = map(int, numbers)
    return width, height, texture_width, texture_height
