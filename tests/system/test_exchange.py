"""`foveascan export` and `foveascan import` against the routes of a node: there and back again."""

import argparse
import asyncio
import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import trimesh
from aiohttp import web
from aiohttp.typedefs import Handler

from client import NodeLost, RequestRefused
from client.exchange_command import add_subcommands
from exchange.errors import ExchangeError
from exchange.formats import read_scan
from exchange.mesh import Band, GridMesh, Seam
from exchange.native import write_native
from exchange.whole_file import whole_file
from node.auth import LOGIN, Login
from node.exchange_routes import ExchangeRoutes
from node.exhibits import Exhibits
from node.library import About, Library
from node.serve import _explain
from protocol.grid import VOID, Grid
from simulators.specimen import make_specimen
from tests.exchange.grids import vase


def run(*arguments: str) -> int:
    parser = argparse.ArgumentParser()
    add_subcommands(parser.add_subparsers(required=True))
    args = parser.parse_args(arguments)
    status: int = args.run(args)
    return status


@contextmanager
def node(folder: Path) -> Iterator[tuple[str, Library]]:
    """A node's exchange in a thread: its URL and its library."""
    library = Library(folder)
    exhibits = Exhibits(library, 32768, 1)
    loop, address = asyncio.new_event_loop(), threading.Event()
    ports: list[int] = []

    @web.middleware
    async def admit(request: web.Request, handler: Handler) -> web.StreamResponse:
        request[LOGIN] = Login("somebody", "admin")
        return await handler(request)

    async def serve(stop: asyncio.Event) -> None:
        app = web.Application(middlewares=[admit, _explain])
        app.add_routes(ExchangeRoutes(exhibits, lambda scan: None).routes())
        runner = web.AppRunner(app)
        await runner.setup()
        site = web.TCPSite(runner, "127.0.0.1", 0)
        await site.start()
        ports.append(runner.addresses[0][1])
        address.set()
        await stop.wait()
        await runner.cleanup()

    stop = asyncio.Event()
    thread = threading.Thread(target=lambda: loop.run_until_complete(serve(stop)))
    thread.start()
    address.wait(10)
    try:
        yield f"http://127.0.0.1:{ports[0]}", library
    finally:
        loop.call_soon_threadsafe(stop.set)
        thread.join()
        loop.close()
        exhibits.close()


def test_a_mesh_goes_in_and_comes_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    ball = tmp_path / "ball.glb"
    trimesh.creation.icosphere(radius=0.02, subdivisions=4).export(ball)  # metres
    with node(tmp_path / "library") as (url, library):
        assert run("import", str(ball), "--size", "72x40:128x64", "--node", url, "--json") == 0
        (scan,) = library.scans()
        note = "a closed mesh seen from a centre at 0.0 mm"
        said = json.loads(capsys.readouterr().out)
        assert said.pop("sizeMm") == pytest.approx([40, 40, 40], abs=0.1)  # a row's half is missing at each pole
        assert said == {"scan": scan.id, "new": True, "geometry": "sphere", "note": note}
        assert (scan.about.name, scan.about.note) == ("ball", note)
        assert run("export", str(tmp_path / "out.stl"), "--node", url, "--scan", scan.id, "--json") == 0
        said = json.loads(capsys.readouterr().out)
    assert said["bytes"] == (tmp_path / "out.stl").stat().st_size
    mesh = trimesh.load_mesh(tmp_path / "out.stl")
    assert np.abs(np.linalg.norm(np.asarray(mesh.vertices), axis=1) - 20).max() < 0.1  # millimetres


def test_a_grid_goes_round_without_a_change(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with node(tmp_path / "library") as (url, library):
        scan = library.add(vase(holes=True), About(0.0, name="vase"))
        assert run("export", str(tmp_path / "vase.npz"), "--node", url) == 0
        assert run("import", str(tmp_path / "vase.npz"), "--node", f"{url}/", "--name", "again") == 0
        said, large = capsys.readouterr().out.splitlines()[-2:]
        assert said == f"scan {scan.id}, which the node had already; it is the newest now"
        corners = GridMesh(scan.grid, Seam.SHARED).positions(Band(0, scan.grid.spec.height))
        across_x, across_y, high = np.ptp(corners, axis=0)
        assert large == f"{across_x:.4g} x {across_y:.4g} mm across, {high:.4g} mm high"
        assert [kept.about for kept in library.scans()] == [About(0.0, name="again")], "it was swept when it was"


def test_a_glb_goes_round_within_a_step(tmp_path: Path) -> None:
    grid = vase()
    with node(tmp_path / "library") as (url, library):
        library.add(grid, About(0.0))
        assert run("export", str(tmp_path / "vase.glb"), "--node", url) == 0
    size, seam = "48x29:160x80", str(np.degrees(grid.spec.theta0_rad))  # rows between the first and last vertex
    assert (
        run("import", str(tmp_path / "vase.glb"), "--size", size, "--theta0-deg", seam, "-o", str(tmp_path / "b.npz"))
        == 0
    )
    back = read_scan(tmp_path / "b.npz")[1]
    between = (grid.range_mm[:-1] + grid.range_mm[1:]) / 2
    assert (back.range_steps != VOID).all() and np.abs(back.range_mm - between).max() <= grid.spec.step_mm
    assert back.spec.pitch_mm == pytest.approx(grid.spec.pitch_mm)


def test_a_mesh_is_a_specimen(tmp_path: Path) -> None:
    trimesh.creation.icosphere(radius=25).export(tmp_path / "ball.ply")
    specimen = make_specimen(tmp_path / "ball.ply", "S")
    assert specimen.name == "ball" and specimen.grid.range_steps.shape == (100, 360)
    assert specimen.range_column(0.3).max() * specimen.grid.spec.step_mm == pytest.approx(25, rel=0.01)


def test_refusals_of_the_node_are_told(tmp_path: Path) -> None:
    nothing = Grid(vase().spec, np.zeros_like(vase().range_steps), vase().texture)
    with node(tmp_path / "library") as (url, library):
        with pytest.raises(RequestRefused, match="no scan '0000"):
            run("export", str(tmp_path / "a.glb"), "--node", url, "--scan", "0" * 32)
        library.add(nothing, About(0.0))
        with pytest.raises(RequestRefused, match="nothing is measured"):
            run("export", str(tmp_path / "a.glb"), "--node", url)
    assert not (tmp_path / "a.glb").exists()


def test_a_format_we_do_not_write_is_refused_before_a_node_is_asked(tmp_path: Path) -> None:
    with pytest.raises(ExchangeError, match="cannot tell its format"):
        run("export", str(tmp_path / "a.xyz"), "--node", "http://127.0.0.1:9")
    with whole_file(tmp_path / "a.npz") as file:
        write_native(vase(), file)
    with pytest.raises(ExchangeError, match=r"only \.npz"):
        run("import", str(tmp_path / "a.npz"), "-o", str(tmp_path / "b.glb"))


def test_a_node_that_is_not_there_is_named_and_the_old_file_stays(tmp_path: Path) -> None:
    (tmp_path / "a.glb").write_bytes(b"old")
    with pytest.raises(NodeLost, match="127.0.0.1:9"):
        run("export", str(tmp_path / "a.glb"), "--node", "http://127.0.0.1:9")
    assert [path.name for path in tmp_path.iterdir()] == ["a.glb"] and (tmp_path / "a.glb").read_bytes() == b"old"


@pytest.mark.parametrize("size", ["Q", "1x2", "1x2:3x", "0x0:0x0:1", "ax1:1x1", "999999x1:1x1"])
def test_a_size_that_is_none_is_refused(size: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        run("import", "x.glb", "--size", size)
    assert "WxH:WtxHt" in capsys.readouterr().err
