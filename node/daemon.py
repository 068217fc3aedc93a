"""The node as a whole: library, capture thread, server and announcement, started in order and stopped in reverse."""

from __future__ import annotations

import asyncio
import logging
import os
import signal
import socket
import sys
import time
from collections.abc import Callable
from contextlib import AsyncExitStack
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version
from pathlib import Path

from drivers.discover import config_for, open_port
from drivers.scanner import SweepEvent
from node.access import Access, access_folder
from node.advertise import Advertisement
from node.assemble import Assembly
from node.capture import Capture, Manner
from node.config import Config
from node.ending import CAPTURE_BY_S, Ending
from node.exhibits import Exhibits
from node.identity import node_identity
from node.library import About, Library, Scan
from node.live import Live
from node.log import set_log
from node.memory import keep_trimmed, settle
from node.notify import Beating, Notifier, keep_notified, status_text
from node.reload import Change, compare
from node.resume import publish_complete
from node.right_of_way import RightOfWay
from node.sealed import finish, leftovers
from node.serve import NodeServer
from node.tls import Tls
from protocol import messages as m
from protocol.errors import AccessError, ConfigError
from protocol.pairing import fingerprint_text
from protocol.scanner_messages import SweepRequest

log = logging.getLogger(__name__)

SWITCH_S = 0.0005  # how long a thread that computes keeps the interpreter from one that has news; Python's is 0.005


@dataclass(slots=True)
class Node:
    """What runs. url : that clients use; capture : the scanner's owner, if there is a scanner."""

    config: Config
    url: str
    server: NodeServer
    exhibits: Exhibits
    capture: Capture | None

    def use(self, wanted: Config) -> Change:
        """Take what can be taken of other settings; what that was, and what was not. Raises AccessError."""
        change = compare(self.config, wanted)
        self.server.use(change.config)
        self.config = change.config
        set_log(change.config.log.level, change.config.log.format)
        if self.capture is not None:
            self.capture.sweep_like(manner_of(change.config))
        return change

    def parts(self) -> dict[str, Beating]:
        """Whose progress shows that the node lives, beside the event loop's."""
        threads: dict[str, Beating] = {"the encoding threads": self.exhibits}
        return threads | ({"the capture thread": self.capture} if self.capture else {})


async def run_node(config: Config, ready: Callable[[str], None], reread: Callable[[], Config]) -> None:
    """Serve until SIGTERM or SIGINT; on SIGHUP, read the settings anew. The process ends with it.

    ready : called once with the node's URL when everything is up.  reread : the settings as they are now; may raise
    ConfigError, and then all stays as it was.
    """
    sys.setswitchinterval(SWITCH_S)
    signals: asyncio.Queue[signal.Signals] = asyncio.Queue()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        loop.add_signal_handler(number, signals.put_nowait, number)
    notifier = Notifier.from_environment(os.environ)
    ending = Ending(of_process=True)
    async with AsyncExitStack() as stack:
        node = await start_node(config, stack, ending)
        settle()
        ready(node.url)
        notifier.ready(status_text(node.url, node.capture))
        keeping = [
            asyncio.create_task(keep_notified(notifier, node.url, node.capture, node.parts())),
            asyncio.create_task(keep_trimmed()),
        ]
        while await signals.get() is signal.SIGHUP:
            notifier.reloading()
            _reload(node, reread)
            notifier.ready(status_text(node.url, node.capture))
        for task in keeping:
            task.cancel()
        ending.begin()
        notifier.stopping()
        log.info("stopping")


def _reload(node: Node, reread: Callable[[], Config]) -> None:
    try:
        change = node.use(reread())
        level = logging.WARNING if change.taken or change.waiting else logging.INFO
        log.log(level, "read the settings anew: %s", change)
    except (ConfigError, AccessError) as error:
        log.error("the settings stay as they were: %s", error)


async def start_node(config: Config, stack: AsyncExitStack, ending: Ending | None = None) -> Node:
    """Bring up every part and leave its end to the stack. ending : the time that it may take."""
    ending = ending or Ending()
    folder = config.library.path
    library = await asyncio.to_thread(Library, folder, config.first_view.max_bytes)
    stack.callback(library.close)
    for left in leftovers(folder):
        log.warning("library: %s was left by a seal or an unseal; stop the node, and %s", left, finish(folder))
    for found in library.found:
        log.warning("library: after the last end: %s", found)
    for problem in library.problems:
        log.warning("library: %s left alone: %s", problem.name, problem.reason)
    finished: list[Scan] = []

    def keep(assembly: Assembly) -> None:
        finished.append(_keep(library, assembly))

    for said in await asyncio.to_thread(
        publish_complete, library.sweeps, keep, config.capture.repair, library.axes
    ):
        log.warning("library: %s", said)
    way = RightOfWay()
    exhibits = Exhibits(library, config.first_view.max_bytes, config.server.encode_workers, way)
    stack.callback(exhibits.close)
    loop = asyncio.get_running_loop()
    live = Live(lambda: loop.call_soon_threadsafe(server.show_live), config.first_view.max_bytes)
    capture, announce = _capture(config, library, live, way)
    info = _server_info(config, folder)
    access, tls = await asyncio.to_thread(_entrance, config, folder, info.id)
    server = NodeServer(config, info, exhibits, live, capture, access, tls)
    host, port = await server.start()
    stack.push_async_callback(server.stop, ending)
    for scan in finished:
        server.swept(scan.id)
    announce.append(lambda scan_id, sweep: loop.call_soon_threadsafe(server.swept, scan_id, sweep))
    if capture is not None:
        capture.start()
        stack.push_async_callback(_stop_capture, capture, ending)
    if config.discovery.enabled:
        await stack.enter_async_context(Advertisement(info.name, info.id, host, port, tls.fingerprint if tls else ""))
    if capture is not None:
        stack.callback(capture.end)  # first of all: while the announcement is withdrawn, its journal is closed
    scheme, address = "https" if tls else "http", f"[{host}]" if ":" in host else host
    return Node(config, f"{scheme}://{address}:{port}", server, exhibits, capture)


async def _stop_capture(capture: Capture, ending: Ending) -> None:
    await asyncio.to_thread(capture.stop, ending.left_s(CAPTURE_BY_S))


def _entrance(config: Config, library: Path, node_id: str) -> tuple[Access | None, Tls | None]:
    """Who may come in, and what they are shown; nothing of it on a node with --insecure."""
    if config.server.insecure:
        log.warning("no login, no encryption: whoever has an account on this machine may do everything (--insecure)")
        return None, None
    folder = access_folder(library)
    tls = Tls(config.server, folder, node_id)
    log.info("certificate: SHA-256 %s", fingerprint_text(tls.fingerprint))
    return Access(folder), tls


def _keep(library: Library, assembly: Assembly) -> Scan:
    scanner, settings = assembly.scanner, assembly.settings
    return library.add(assembly.grid, About(time.time(), quality=assembly.quality, scanner=scanner, settings=settings))


def _capture(
    config: Config, library: Library, live: Live, way: RightOfWay
) -> tuple[Capture | None, list[Callable[[str, int], object]]]:
    """The capture thread's owner, and the list of who is told of each new scan, and which sweep it is."""
    announce: list[Callable[[str, int], object]] = []
    address = config.capture.scanner
    if address is None:
        return None, announce

    def deliver(assembly: Assembly) -> None:
        scan = _keep(library, assembly)
        log.info("scan published: %d x %d", scan.spec.width, scan.spec.height)
        for complaint in assembly.quality.complaints:
            log.warning("scan: %s", complaint)
        live.published(scan.id)
        for tell in announce:
            tell(scan.id, capture.status.sweeps + 1)

    def watch(event: SweepEvent) -> None:
        way.watch(event)
        live.watch(event)

    opened = partial(open_port, address, config.capture.baud)
    link = config_for(address, config.capture.stale_s)
    capture = Capture(opened, link, deliver, watch, library.sweeps, manner_of(config), library.axes)
    return capture, announce


def manner_of(config: Config) -> Manner:
    """How to sweep."""
    c = config.capture
    return Manner(SweepRequest(passes=c.passes, overlap=c.overlap, stride=c.stride), c.apart, c.repair)


def _server_info(config: Config, folder: Path) -> m.ServerInfo:
    name = config.discovery.name or socket.gethostname()
    return m.ServerInfo(m.PROTOCOL, node_identity(folder), name, version("foveascan"), login=not config.server.insecure)
