"""What people say of a scan: name, subject, body site, time, notes, pins; and who said it when.

`sidecar.json` in the scan's folder is a history to which every change is appended, exchanged as a whole in one step.
The present state is the sum of the changes, so the two cannot disagree. A checksum tells whether it has rotted; then it
is reported, and neither shown nor written over. The samples of the scan have nothing to do with any of this.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Annotated, Any

import msgspec
from msgspec import UNSET, Meta, Struct, UnsetType

from node.durable import decode_kept, disk_error, read_bounded, write_whole
from protocol.errors import LibraryError

FORMAT = 1
FILE = "sidecar.json"
FILE_BYTES_MAX = 4 << 20
CHANGE_BYTES_MAX = 1 << 16
BY_MAX = 100

UnixTime = Annotated[float, Meta(ge=0, le=1e11)]  # [s since 1970]
Share = Annotated[float, Meta(ge=0, lt=1)]


class Conflict(LibraryError):
    """Somebody else changed it in the meantime."""


class Pin(Struct, frozen=True, forbid_unknown_fields=True):
    """A place on the scan worth a word. u, v : as in a click.  label : at most 200 characters."""

    u: Share
    v: Share
    label: Annotated[str, Meta(max_length=200)] = ""


class Changes(Struct, frozen=True, forbid_unknown_fields=True):
    """New values of some fields; a field that is not there stays as it is.

    name : what to call the scan.  subject : the patient's code, never a name.  body_site : which part was scanned.
    taken_unix_s : when, where the node's clock was wrong.  notes : free text.  pins : all of them, in their order.
    """

    name: Annotated[str, Meta(max_length=200)] | UnsetType = UNSET
    subject: Annotated[str, Meta(max_length=64)] | UnsetType = UNSET
    body_site: Annotated[str, Meta(max_length=100)] | UnsetType = UNSET
    taken_unix_s: UnixTime | None | UnsetType = UNSET
    notes: Annotated[str, Meta(max_length=8000)] | UnsetType = UNSET
    pins: Annotated[tuple[Pin, ...], Meta(max_length=100)] | UnsetType = UNSET


class Change(Struct, frozen=True, forbid_unknown_fields=True):
    """One entry of the history: when (the node's clock), who, what."""

    at_unix_s: float
    by: Annotated[str, Meta(max_length=BY_MAX)]
    set: Changes


class Sidecar(Struct, frozen=True):
    """What is said of a scan now. revision : how many changes made it so; name is None until somebody renames it."""

    revision: int = 0
    name: str | None = None
    subject: str = ""
    body_site: str = ""
    taken_unix_s: float | None = None
    notes: str = ""
    pins: tuple[Pin, ...] = ()
    history: tuple[Change, ...] = ()


class _File(Struct, frozen=True, forbid_unknown_fields=True):
    """sidecar.json. sha256 : of the bytes of history as they stand in the file."""

    format: int
    sha256: str
    history: msgspec.Raw


class _Version(Struct, frozen=True):
    format: int


def decode_changes(data: bytes) -> Changes:
    """Changes as JSON from a client. Raises ValueError, naming the field, when something is wrong or too long."""
    if len(data) > CHANGE_BYTES_MAX:
        raise ValueError(f"changes of {len(data)} bytes, at most {CHANGE_BYTES_MAX} are taken")
    try:
        return msgspec.json.decode(data, type=Changes)
    except (msgspec.DecodeError, UnicodeError) as error:
        raise ValueError(str(error)) from error


def changed_fields(changes: Changes) -> list[str]:
    """Which fields get new values."""
    return [name for name in Changes.__struct_fields__ if getattr(changes, name) is not UNSET]


def read_sidecar(folder: Path) -> Sidecar:
    """What is said of the scan in a folder; nothing, where nobody has said anything. Raises LibraryError."""
    try:
        return sidecar_of(_decode(read_bounded(folder / FILE, FILE_BYTES_MAX)))
    except FileNotFoundError:
        return Sidecar()
    except OSError as error:
        raise disk_error(f"its {FILE} cannot be read", error) from error


def change_sidecar(
    folder: Path, changes: Changes, by: str, at_unix_s: float, revision: int | None = None
) -> Sidecar:
    """Append a change, durable before this returns.

    revision : the one it is meant for, or None for whichever there is; another one is a Conflict.
    Raises ValueError when changes or `by` are out of bounds, LibraryError when it cannot be read or written.
    """
    now = read_sidecar(folder)
    if revision is not None and revision != now.revision:
        raise Conflict(f"somebody changed it: it is at revision {now.revision}, not {revision}")
    history = (*now.history, _checked(Change(at_unix_s, by, changes)))
    data = _encode(history)
    if len(data) > FILE_BYTES_MAX:
        raise LibraryError(f"its {FILE} is full: the history takes {FILE_BYTES_MAX} bytes at most")
    try:
        write_whole(folder / FILE, data)
    except OSError as error:
        raise disk_error(f"cannot write its {FILE}", error) from error
    return sidecar_of(history)


def sidecar_of(history: tuple[Change, ...]) -> Sidecar:
    """The sum of all changes."""
    said: dict[str, Any] = {}
    for change in history:
        values = ((name, getattr(change.set, name)) for name in Changes.__struct_fields__)
        said |= {name: value for name, value in values if value is not UNSET}
    return Sidecar(revision=len(history), history=history, **said)


def _checked(change: Change) -> Change:
    """Bounds are checked where JSON is read, and a caller in this process may have made anything."""
    if not changed_fields(change.set):
        raise ValueError("it changes nothing")
    try:
        return msgspec.json.decode(msgspec.json.encode(change), type=Change)
    except msgspec.DecodeError as error:
        raise ValueError(str(error)) from error


def _encode(history: tuple[Change, ...]) -> bytes:
    raw = msgspec.json.encode(history)
    return msgspec.json.encode(_File(FORMAT, hashlib.sha256(raw).hexdigest(), msgspec.Raw(raw))) + b"\n"


def _decode(data: bytes) -> tuple[Change, ...]:
    what = f"its {FILE}"
    if decode_kept(data, _Version, what).format != FORMAT:
        raise LibraryError(f"{what} is written in a format that this version does not know")
    file = decode_kept(data, _File, what)
    if hashlib.sha256(file.history).hexdigest() != file.sha256:
        raise LibraryError(f"{what} is damaged: it is not what was written")
    return decode_kept(bytes(file.history), tuple[Change, ...], what)
