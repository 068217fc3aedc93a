"""Sealed libraries for tests, where this machine lets us mount."""

from __future__ import annotations

import os
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

import pytest

from node.sealed import is_open, make_sealed, opened, sealed_folder
from protocol.errors import LibraryError

KEY = b"correct horse battery staple, or so"


@cache
def _why_not() -> str:
    """Why nothing can be mounted here; "" where it can."""
    with tempfile.TemporaryDirectory() as name:
        try:
            make_sealed(Path(name) / "s", KEY)
            with opened(Path(name) / "s", Path(name) / "o", KEY):
                return ""
        except LibraryError as error:
            return str(error)


def require_mounts() -> None:
    """Skip where gocryptfs is missing or may not mount, as in most containers."""
    if why := _why_not():
        pytest.skip(why)


@contextmanager
def open_at(folder: Path) -> Iterator[subprocess.Popen[bytes]]:
    """A sealed library open where it belongs, as the vault's unit opens it."""
    command = ["gocryptfs", "-fg", "-q", "-nosyslog", str(sealed_folder(folder)), str(folder)]
    with subprocess.Popen(command, stdin=subprocess.PIPE) as process:
        assert process.stdin is not None
        process.stdin.write(KEY + b"\n")
        process.stdin.close()
        try:
            while not is_open(folder):
                assert process.poll() is None
            yield process
        finally:
            lazily = ["umount", "--lazy"] if os.geteuid() == 0 else ["fusermount3", "-uz"]
            subprocess.run([*lazily, str(folder)], check=False)  # scans that were opened may still be mapped
            process.kill()
