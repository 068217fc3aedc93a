"""Files that appear whole or not at all."""

from __future__ import annotations

import errno
import os
import secrets
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import BinaryIO


@contextmanager
def whole_file(path: str | Path, *, private: bool = False) -> Iterator[BinaryIO]:
    """A file to write, under its name only once the block has ended well. Raises OSError when it cannot be written.

    private : for this user's eyes only.
    """
    target = Path(path)
    temporary = target.with_name(f".{target.name[:200]}.{secrets.token_hex(4)}")
    try:
        with _named(target):
            file = open(temporary, "x+b", opener=partial(os.open, mode=0o600 if private else 0o666))
        with file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        with _named(target):
            os.replace(temporary, target)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def check_place(path: str | Path) -> None:
    """Raises OSError where `whole_file` could not write, before any work is done for it. Leaves nothing there."""
    target = Path(path)
    if target.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(target))
    with _named(target), tempfile.TemporaryFile(dir=target.parent):
        pass


@contextmanager
def _named(target: Path) -> Iterator[None]:
    """Errors of the file system name what was to be written, not how it is done."""
    try:
        yield
    except OSError as error:
        if error.filename is not None:
            error.filename, error.filename2 = str(target), None
        raise
