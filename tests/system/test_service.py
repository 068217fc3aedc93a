"""The daemon as its unit runs it: what systemd hears, and how it ends."""

from __future__ import annotations

import asyncio
import os
import signal
import socket
import subprocess
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from client import NodeLost, connect
from foveascan import PROGRAM, started
from node.library import Library
from tests.system.line import RunningNode
from tests.waiting import until_ready

STOP_S = 30.0  # AT-36 has 5 s on a machine that is not loaded; what hangs takes for ever
WATCHDOG_S = 8.0


@contextmanager
def notification_socket(path: Path) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as line:
        line.bind(str(path))
        line.settimeout(20)
        yield line


def hear(line: socket.socket, start: str) -> dict[str, str]:
    """The next notification that begins so, as its fields."""
    while not (said := line.recv(4096).decode()).startswith(start):
        pass
    return dict(field.split("=", 1) for field in said.splitlines())


def serve(folder: Path, *more: str) -> list[str]:
    return ["serve", "--library", str(folder / "library"), "--listen", "127.0.0.1:0", "--insecure", "--json", *more]


def text_frame(message: str) -> bytes:
    """A WebSocket frame as clients send it, masked with zeros; up to 125 bytes."""
    return bytes([0x81, 0x80 | len(message), 0, 0, 0, 0]) + message.encode()


def deaf_client(url: str) -> socket.socket:
    """A client that asks for more than its receive buffer holds and never reads what it is told."""
    host, _, port = url.removeprefix("http://").rpartition(":")
    line = socket.socket()
    line.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
    line.settimeout(5)
    line.connect((host, int(port)))
    upgrade = "Connection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13\r\n"
    key = "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Protocol: foveascan.v1\r\n"
    line.sendall(f"GET /v1/stream HTTP/1.1\r\nHost: {host}\r\n{upgrade}{key}\r\n".encode())
    assert line.recv(12) == b"HTTP/1.1 101"
    line.sendall(text_frame('{"type":"hello","protocol":"foveascan.v1"}'))
    for request in range(200):
        line.sendall(text_frame(f'{{"type":"open","request":{request},"scan":"latest"}}'))
    return line


async def ready_to_sweep(url: str) -> None:
    async with connect(url) as session:
        await until_ready(session)


def test_systemd_hears_ready_when_it_is_true_then_life_then_the_end(tmp_path: Path) -> None:
    environ = os.environ | {"NOTIFY_SOCKET": str(tmp_path / "n"), "WATCHDOG_USEC": str(int(WATCHDOG_S * 1e6))}
    with notification_socket(tmp_path / "n") as line:
        with subprocess.Popen([*PROGRAM, *serve(tmp_path)], env=environ, stdout=subprocess.DEVNULL) as node:
            status = hear(line, "READY=1")["STATUS"]
            url = status.removeprefix("Serving ").partition(",")[0]
            with urllib.request.urlopen(f"{url}/healthz", timeout=5) as answer:
                assert answer.status == 200
            for _ in range(2):
                hear(line, "WATCHDOG=1")
            began_s = time.monotonic()
            node.terminate()
            assert hear(line, "STOPPING=1")
            assert node.wait(STOP_S) == 0
            assert time.monotonic() - began_s < STOP_S


def test_sighup_takes_up_what_can_be_and_says_what_waits(tmp_path: Path) -> None:
    settings = tmp_path / "node.toml"
    library = f"[library]\nfolder = \"{tmp_path}/library\"\n"
    serve = "[server]\nlisten = \"127.0.0.1:0\"\ninsecure = true\n"
    settings.write_text(library + serve)
    environ = os.environ | {"NOTIFY_SOCKET": str(tmp_path / "n")}
    command = [*PROGRAM, "serve", "--config", str(settings), "--json"]
    with (
        notification_socket(tmp_path / "n") as line,
        subprocess.Popen(command, env=environ, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as node,
    ):
        assert node.stderr is not None
        first = hear(line, "READY=1")["STATUS"]

        def reload(text: str) -> str:
            """What the log says after these settings were read."""
            settings.write_text(text)
            node.send_signal(signal.SIGHUP)
            assert int(hear(line, "RELOADING=1")["MONOTONIC_USEC"]) <= time.monotonic_ns() // 1000
            assert hear(line, "READY=1")["STATUS"] == first
            assert node.stderr is not None
            while "settings" not in (said := node.stderr.readline()):
                pass
            return said.split(": ", 1)[1].strip()

        assert reload(library + serve + "max_clients = 1\nencode_workers = 1\n[log]\nlevel = \"warning\"\n") == (
            "read the settings anew: server.max_clients, log.level changed; for server.encode_workers restart the node"
        )
        assert reload("max_clients = 3").startswith(f"the settings stay as they were: {settings}: max_clients: unknown")
        assert reload(library + serve + "max_clients = 2").startswith("read the settings anew: server.max_clients, log")
        node.terminate()
        assert node.wait(STOP_S) == 0


def test_a_node_that_cannot_listen_never_says_ready(tmp_path: Path) -> None:
    environ = os.environ | {"NOTIFY_SOCKET": str(tmp_path / "n")}
    with notification_socket(tmp_path / "n") as line, socket.create_server(("127.0.0.1", 0)) as taken:
        arguments = serve(tmp_path, "--listen", f"127.0.0.1:{taken.getsockname()[1]}")
        failed = subprocess.run([*PROGRAM, *arguments], env=environ, capture_output=True, timeout=60)
        assert failed.returncode == 1
        line.setblocking(False)
        with pytest.raises(BlockingIOError):
            line.recv(4096)


def test_sigterm_with_clients_that_do_not_read(line: Callable[..., RunningNode]) -> None:
    node = line("--specimen", "sphere")
    deaf = [deaf_client(node.url) for _ in range(2)]
    began_s = time.monotonic()
    node.process.terminate()
    assert node.process.wait(STOP_S) == 0
    assert time.monotonic() - began_s < STOP_S
    for client in deaf:
        client.close()


async def test_sigterm_in_the_middle_of_a_sweep_tells_clients_and_keeps_its_columns(tmp_path: Path) -> None:
    simulate = ["simulate", "--path", str(tmp_path / "tty"), "--link-rate", "100000", "--json"]
    with started(*simulate) as (_, link), started(*serve(tmp_path, "--scanner", link["path"])) as (node, ready):
        await ready_to_sweep(ready["url"])
        async with connect(ready["url"]) as session:
            await session.start_sweep()
            news, is_told = session.published(), False
            async for frame in session.live():
                if frame.percent > 10 and not is_told:
                    is_told = True
                    node.terminate()
            assert frame.ended == "interrupted"
            with pytest.raises(NodeLost, match="the node is stopping"):
                await anext(news)
            assert await asyncio.to_thread(node.wait, STOP_S) == 0
    library = Library(tmp_path / "library")
    (kept,) = library.sweeps.interrupted()
    assert not library.scans() and not kept.is_complete
    assert len(list(library.sweeps.columns(kept.id))) > 10


HANGS = """
import os, time
from pathlib import Path

def hanging(sync):
    def synced(file):
        while Path({flag!r}).exists():
            time.sleep(0.05)
        sync(file)
    return synced

os.fsync, os.fdatasync = hanging(os.fsync), hanging(os.fdatasync)
"""


async def test_sigterm_while_the_disk_hangs_ends_in_time_and_keeps_every_column(tmp_path: Path) -> None:
    """What the node could not make durable is in the system's hands: a disk that comes back has it."""
    hung = tmp_path / "hung"
    (tmp_path / "sitecustomize.py").write_text(HANGS.format(flag=str(hung)))
    path = os.pathsep.join([str(tmp_path), *filter(None, [os.environ.get("PYTHONPATH")])])
    simulate = ["simulate", "--path", str(tmp_path / "tty"), "--link-rate", "100000", "--json"]
    with started(*simulate) as (_, link):
        command = serve(tmp_path, "--scanner", link["path"])
        with started(*command, environment={"PYTHONPATH": path}) as (node, ready):
            await ready_to_sweep(ready["url"])
            async with connect(ready["url"]) as session:
                await session.start_sweep()
                news, shown = session.published(), 0.0
                with pytest.raises(NodeLost, match="the node is stopping"):
                    async for frame in session.live():
                        if frame.percent > 10 and not shown:
                            hung.touch()
                        if frame.percent > 40 and not shown:
                            shown = frame.percent
                            node.terminate()
                    await anext(news)
                assert await asyncio.to_thread(node.wait, STOP_S) == 0
    (kept,) = Library(tmp_path / "library").sweeps.interrupted()
    assert 100 * kept.held >= shown * kept.expected > 0
    assert "stop" in kept.why


def test_the_doctor_hears_the_node(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    settings = tmp_path / "node.toml"
    library = f"[library]\nfolder = \"{tmp_path}/library\"\n"
    settings.write_text(f"[server]\nlisten = \"127.0.0.1:{port}\"\ninsecure = true\n{library}")
    doctor = [*PROGRAM, "doctor", "--config", str(settings)]
    with started("serve", "--config", str(settings), "--json"):
        told = subprocess.run(doctor, capture_output=True, text=True, timeout=60)
    assert f"ok       server         a node answers at 127.0.0.1:{port}" in told.stdout
    assert "warning  discovery      only this machine can reach and find it" in told.stdout


async def test_kill_9_and_a_new_start_let_clients_go_on(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    again = serve(tmp_path, "--listen", f"127.0.0.1:{port}")
    with started(*again) as (node, ready):
        async with connect(ready["url"]) as session:
            node.kill()
            with pytest.raises(NodeLost):
                await anext(session.published())
    with started(*again) as (_, restarted):
        assert restarted["url"] == ready["url"]
        async with connect(restarted["url"]) as session:
            assert await session.scans() == []
