"""The daemon as it is started, and those who keep it waiting: they are cut off, and a client is served meanwhile."""

from __future__ import annotations

import asyncio
import os
import ssl
from contextlib import suppress
from pathlib import Path

from client import connect
from foveascan import started
from node.access import Access, access_folder
from node.library import About, Library
from node.tls import FILE, certificate_fingerprint
from tests.node.scans import make_grid

SLOW = 40
UNTRUSTING = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
UNTRUSTING.check_hostname, UNTRUSTING.verify_mode = False, ssl.CERT_NONE
LIMITS = "[limits]\nhead_s = 5\nconnections_per_address = 50\n[discovery]\nenabled = false\n"


async def test_those_who_say_nothing_are_cut_off_and_nobody_notices(tmp_path: Path) -> None:
    library, settings = tmp_path / "library", tmp_path / "node.toml"
    kept = Library(library)
    kept.add(make_grid(40, 24), About(1e9))
    kept.close()
    settings.write_text(LIMITS)
    serve = "serve", "--config", str(settings), "--library", str(library), "--listen", "127.0.0.1:0", "--json"
    with started(*serve) as (node, ready):
        token = Access(access_folder(library)).grant("view", "room 2", 1e9)
        fingerprint = certificate_fingerprint(library / "access" / FILE)
        port = int(ready["url"].rpartition(":")[2])
        silent = [asyncio.create_task(kept_waiting(port, tls=number % 2 == 0)) for number in range(SLOW)]
        async with connect(ready["url"], token, fingerprint) as session:
            await session.open()
            while not all(task.done() for task in silent):
                await session.look(0.5, 0.5)
        assert [task.result() for task in silent] == [b""] * SLOW
        assert len(os.listdir(f"/proc/{node.pid}/fd")) < SLOW


async def kept_waiting(port: int, *, tls: bool) -> bytes:
    """Whatever comes on a connection that says half a head, or does not even begin its handshake."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port, ssl=UNTRUSTING if tls else None)
    if tls:
        writer.write(b"GET /healthz HTT")
    said = b""
    with suppress(ConnectionError):
        async with asyncio.timeout(30):
            said = await reader.read()
    writer.transport.abort()
    return said
