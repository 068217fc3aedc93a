"""New settings for a node that runs (SIGHUP): what can be taken is taken, the rest is named and waits for a restart."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import msgspec

from node.config import Config, Limits

LIVE = frozenset({
    "capture.passes", "capture.overlap", "capture.stride", "capture.apart", "capture.repair",
    "server.certificate", "server.key", "server.max_clients",
    "planner.cold_start_bytes_s",
    "retention.max_age_days", "retention.max_gb",
    "log.level", "log.format", "library.spheres",
    *(f"limits.{key}" for key in Limits.__struct_fields__),
})  # fmt: skip


@dataclass(frozen=True, slots=True)
class Change:
    """config : to go on with.  taken, waiting : places of settings that changed, as "server.key"."""

    config: Config
    taken: tuple[str, ...]
    waiting: tuple[str, ...]

    def __str__(self) -> str:
        """In one line, for the log."""
        said = ", ".join(self.taken) or "no setting"
        return f"{said} changed" + (f"; for {', '.join(self.waiting)} restart the node" if self.waiting else "")


def compare(running: Config, wanted: Config) -> Change:
    """What of the wanted settings a running node can take."""
    taken: list[str] = []
    waiting: list[str] = []
    sections: dict[str, Any] = {}
    for name in running.__struct_fields__:
        section = getattr(running, name)
        new: dict[str, object] = {}
        for key in section.__struct_fields__:
            value = getattr(getattr(wanted, name), key)
            if value != getattr(section, key):
                place = f"{name}.{key}"
                (taken if place in LIVE else waiting).append(place)
                if place in LIVE:
                    new[key] = value
        sections[name] = msgspec.structs.replace(section, **new)
    return Change(Config(**sections), tuple(taken), tuple(waiting))
