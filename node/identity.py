"""The node's own id: drawn once, kept beside its scans, so that clients know a node again whatever its address."""

from __future__ import annotations

import re
import secrets
from pathlib import Path

from node.durable import read_bounded, write_whole
from protocol.errors import LibraryError

FILE = "node-id"
FILE_BYTES_MAX = 64


def node_identity(folder: Path) -> str:
    """The id kept in a folder, 16 hex digits; drawn and written the first time. Raises LibraryError."""
    if (known := known_identity(folder)) is not None:
        return known
    drawn, path = secrets.token_hex(8), folder / FILE
    try:
        write_whole(path, drawn.encode())
    except OSError as error:
        raise LibraryError(f"{path}: {error.strerror}") from error
    return drawn


def known_identity(folder: Path) -> str | None:
    """The id kept in a folder; None where none was drawn yet. Raises LibraryError."""
    path = folder / FILE
    try:
        text = read_bounded(path, FILE_BYTES_MAX).decode(errors="replace").strip()
    except FileNotFoundError:
        return None
    except OSError as error:
        raise LibraryError(f"{path}: {error.strerror}") from error
    if not re.fullmatch("[0-9a-f]{16}", text):
        raise LibraryError(f"{path}: is no node id; remove it to have one drawn anew")
    return text
