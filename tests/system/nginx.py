"""A real nginx before a node, with the configuration that we give to wards."""

from __future__ import annotations

import os
import re
import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

SAMPLE = Path(__file__).parents[2] / "systemd" / "nginx-cache.conf"
KEPT = "/dev/shm/foveascan-cache"
ACCESS = "/var/lib/foveascan/access"


@contextmanager
def nginx_before(node_url: str, library: Path, folder: Path) -> Iterator[str]:
    """The URL of an nginx with our sample, its addresses and folders changed to ones of this test."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    ours = {
        KEPT: str(folder / "cache"),
        ACCESS: str(library / "access"),
        "127.0.0.1:7345": node_url.removeprefix("https://"),
        "listen 443": f"listen 127.0.0.1:{port}",
    }
    sample = SAMPLE.read_text()
    for theirs, own in ours.items():
        assert theirs in sample
        sample = sample.replace(theirs, own)
    assert not re.search(r"(?<!#)[^#\n]*(127\.0\.0\.1:734|/var/|/dev/)", re.sub("(?m)^ *#.*$", "", sample))
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
            yield f"https://127.0.0.1:{port}"
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
