"""A real nginx before the node: a ward of viewers looking at the same places costs the node one encode each."""

from __future__ import annotations

import asyncio
import os
import re
import shutil
import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import aiohttp
import numpy as np

from client.shared import open_shared
from foveascan import started
from tests.system.line import RunningNode
from tests.system.needs import needs

SAMPLE = Path(__file__).parents[2] / "systemd" / "nginx-cache.conf"
VIEWERS = 32
PLACES = [(0.45, 0.4), (0.55, 0.45), (0.5, 0.6)]


@needs("nginx")
async def test_32_viewers_of_the_same_places_cost_one_encode_each(head_node: RunningNode, tmp_path: Path) -> None:
    library = shutil.copytree(head_node.folder / "library", tmp_path / "library")
    settings = tmp_path / "node.toml"
    settings.write_text("[server]\ninsecure = true\nshared_cache = true\n")
    serve = ["serve", "--config", str(settings), "--library", str(library), "--listen", "127.0.0.1:0", "--json"]
    with started(*serve) as (_, ready), nginx_before(ready["url"], tmp_path) as url:
        before = await shared_encodes(url)
        viewers = await asyncio.gather(*(look_at_all(url) for _ in range(VIEWERS)))
        assert await shared_encodes(ready["url"]) - before == len(PLACES)
    first = viewers[0][0]
    assert first.max() > 0
    for steps, _ in viewers:
        np.testing.assert_array_equal(steps, first)
    assert sum(hits for _, hits in viewers) >= (VIEWERS - 1) * len(PLACES) // 2


async def look_at_all(url: str) -> tuple[np.ndarray, int]:
    async with open_shared(url) as viewer:
        for u, v in PLACES:
            await viewer.look(u, v)
        return viewer.model.range_steps.copy(), viewer.hits


async def shared_encodes(url: str) -> int:
    async with aiohttp.ClientSession() as http, http.get(f"{url}/v1/node") as response:
        return int((await response.json())["sharedEncodes"])


@contextmanager
def nginx_before(node_url: str, folder: Path) -> Iterator[str]:
    """nginx with our sample configuration, its addresses and folders changed to ones of this test."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    sample = SAMPLE.read_text().replace("/var/cache/nginx/foveascan", str(folder / "cache"))
    sample = sample.replace("127.0.0.1:7345", node_url.removeprefix("http://"))
    sample = sample.replace("127.0.0.1:7346", f"127.0.0.1:{port}")
    assert not re.search("127.0.0.1:734|/var/", sample)
    folders = "".join(
        f"{kind}_temp_path {folder}/{kind};" for kind in ("client_body", "proxy", "fastcgi", "uwsgi", "scgi")
    )
    user = "user root; " if os.geteuid() == 0 else ""  # else its workers could not write to our folder
    frame = f"{user}pid {folder}/pid; daemon off; error_log {folder}/error.log; events {{}}"
    (folder / "nginx.conf").write_text(f"{frame} http {{ access_log off; {folders} {sample} }}")
    command = ["nginx", "-p", str(folder), "-e", str(folder / "error.log"), "-c", str(folder / "nginx.conf")]
    with subprocess.Popen(command) as server:
        try:
            _await_listening(port)
            yield f"http://127.0.0.1:{port}"
        finally:
            server.terminate()


def _await_listening(port: int) -> None:
    until = time.monotonic() + 10
    while time.monotonic() < until:
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", port)) == 0:
                return
        time.sleep(0.02)
    raise AssertionError("nginx does not listen")
