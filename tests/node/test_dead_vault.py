"""What clients are told when what had opened a sealed library has died: 503 and why, and no scan is taken for lost."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest

from node.library import About, Library
from node.sealed import HAS_DIED
from node.sealing import seal
from tests.node.scans import make_grid
from tests.node.sealed_places import KEY, open_at
from tests.node.served import served

pytestmark = pytest.mark.usefixtures("mounts")

SCAN_REQUESTS = [
    ("GET", ".glb"),
    ("GET", ".npz"),
    ("GET", "/coarse"),
    ("GET", "/fovea?u=0.5&v=0.5"),
    ("GET", "/sidecar"),
    ("PATCH", "/sidecar"),
    ("POST", "/verify"),
    ("POST", "/derive"),
    ("DELETE", ""),
]


async def test_every_request_for_a_scan_says_that_the_vault_has_died(tmp_path: Path) -> None:
    folder = tmp_path / "library"
    library = Library(folder)
    scan = library.add(make_grid(), About(1e9)).id
    library.close()
    seal(folder, KEY, lambda size: None)
    with open_at(folder) as vault:
        async with served(Library(folder)) as (node, _):
            vault.send_signal(signal.SIGKILL)
            vault.wait()
            told = {}
            for method, what in SCAN_REQUESTS:
                body = {"name": "x"} if method == "PATCH" else {"geometry": "sphere"} if method == "POST" else None
                async with node.request(method, f"/v1/scans/{scan}{what}", json=body) as answer:
                    told[method, what] = answer.status, (await answer.json())["message"]
            assert told == {request: (503, HAS_DIED) for request in SCAN_REQUESTS}
            async with node.get("/v1/scans") as answer:
                assert [one["id"] for one in await answer.json()] == [scan], "it is not lost"
