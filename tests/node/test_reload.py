"""What of other settings a node that runs can take."""

from __future__ import annotations

from node.config import Capture, Config, Library, Planner, Server
from node.reload import LIVE, compare


def test_what_can_be_taken_is_taken_and_the_rest_named() -> None:
    running = Config(server=Server(listen="127.0.0.1:1", max_clients=8), library=Library("/a"))
    wanted = Config(
        capture=Capture(scanner="/dev/x", passes=4),
        server=Server(listen="127.0.0.1:2", max_clients=9),
        library=Library("/a"),
        planner=Planner(2e6),
    )
    change = compare(running, wanted)
    assert change.taken == ("capture.passes", "server.max_clients", "planner.cold_start_bytes_s")
    assert change.waiting == ("capture.scanner", "server.listen")
    assert change.config.capture == Capture(passes=4)
    assert change.config.server == Server(listen="127.0.0.1:1", max_clients=9)
    assert str(change).endswith("changed; for capture.scanner, server.listen restart the node")


def test_the_same_settings_change_nothing() -> None:
    change = compare(Config(), Config())
    assert change.config == Config() and str(change) == "no setting changed"


def test_what_can_be_taken_are_settings() -> None:
    sections = {name: getattr(Config(), name) for name in Config().__struct_fields__}
    assert {f"{name}.{key}" for name, section in sections.items() for key in section.__struct_fields__} > LIVE
