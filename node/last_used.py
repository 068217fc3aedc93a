"""When each token was shown last: for whoever looks whether a login is still needed.

    <library>/access/used.json      SHA-256 of the token -> s since 1970

Kept by the daemon alone, now and then and when it stops: a crash forgets some minutes, which nobody misses.
"""

from __future__ import annotations

import logging
from collections.abc import Collection
from pathlib import Path
from typing import Annotated

from msgspec import Meta, json

from node.durable import decode_kept, read_bounded, write_whole
from protocol.errors import LibraryError
from protocol.pairing import Hex256

log = logging.getLogger(__name__)

FILE = "used.json"
FILE_BYTES_MAX = 1 << 20
Times = dict[Hex256, Annotated[float, Meta(ge=0, le=1e11)]]


class LastUsed:
    """The times of every token, by its digest. folder : that of `node.access`."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / FILE
        self._times = _read(self._path)
        self._is_kept = True

    def note(self, digest: str, now_unix_s: float) -> None:
        """A token was shown."""
        self._times[digest] = now_unix_s
        self._is_kept = False

    def of(self, digest: str) -> float | None:
        """When it was shown last; None: never, or nobody knows."""
        return self._times.get(digest)

    def keep(self, standing: Collection[str]) -> None:
        """Write down what is new, of the tokens that stand. On a disk that is full it is tried again later."""
        if self._is_kept:
            return
        self._is_kept = True
        kept = {one: at for one, at in self._times.copy().items() if one in standing}
        try:
            write_whole(self._path, json.encode(kept), private=True)
        except OSError as error:
            self._is_kept = False
            log.warning("when tokens were used cannot be kept: %s", error.strerror)


def _read(path: Path) -> Times:
    """What was kept; nothing where that is damaged: it will fill again."""
    try:
        return decode_kept(read_bounded(path, FILE_BYTES_MAX), Times, path.name)
    except FileNotFoundError:
        return {}
    except (OSError, LibraryError) as error:
        log.warning("when tokens were used is not known any more: %s", error)
        return {}
