from __future__ import annotations

from pathlib import Path

import pytest
from aiohttp import web

from client import transfer
from client.transfer import fetch_scan
from protocol.errors import RemoteWireError
from tests.client.scripted_node import serving, until_gone


def exporting(content: bytes, status: int = 200) -> web.RouteDef:
    async def export(request: web.Request) -> web.StreamResponse:
        response = web.StreamResponse(status=status)  # without a length: it says nothing of how long it goes on
        await response.prepare(request)
        await response.write(content)
        return response

    return web.get("/v1/scans/latest.stl", export)


async def test_a_file_is_whole_or_what_it_was_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(transfer, "FILE_BYTES_MAX", 1000)
    path, told = tmp_path / "scan.stl", list[int]()
    async with serving(until_gone, exporting(bytes(1000))) as url:
        assert await fetch_scan(url, "latest", path, moved=lambda done, total: told.append(done)) == 1000
    assert path.read_bytes() == bytes(1000) and told[-1] == 1000
    path.write_bytes(b"before")
    for content, status, why in ((bytes(1001), 200, "more than 1000"), (b"{}", 202, "with HTTP 202")):
        async with serving(until_gone, exporting(content, status)) as url:
            with pytest.raises(RemoteWireError, match=why):
                await fetch_scan(url, "latest", path, moved=lambda done, total: None)
        assert path.read_bytes() == b"before" and list(tmp_path.iterdir()) == [path]
