"""What this user's clients know of the nodes they were paired with: one private file."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import msgspec
from msgspec import Meta, Struct

from exchange.whole_file import whole_file
from protocol.errors import AccessError
from protocol.pairing import Name, Role

FILE_BYTES_MAX = 1 << 20
CREDENTIALS_MAX = 1000
Text = Annotated[str, Meta(min_length=1, max_length=300)]


class Credential(Struct, frozen=True):
    """A pairing. node : its id; url : where it was; key : SHA-256 of its public key, "" where authorities vouch."""

    node: Text
    url: Text
    name: Name
    role: Role
    token: Text
    key: Annotated[str, Meta(pattern="^([0-9a-f]{64})?$")] = ""


class _File(Struct, frozen=True):
    credentials: Annotated[tuple[Credential, ...], Meta(max_length=CREDENTIALS_MAX)] = ()


def credentials_path() -> Path:
    """Where they are: $XDG_CONFIG_HOME/foveascan/nodes.json, else below ~/.config."""
    home = os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config"
    return Path(home) / "foveascan" / "nodes.json"


def read_credentials() -> tuple[Credential, ...]:
    """All of them, the latest last. Raises AccessError."""
    path = credentials_path()
    try:
        with open(path, "rb") as file:
            data = file.read(FILE_BYTES_MAX)
        return msgspec.json.decode(data, type=_File).credentials
    except FileNotFoundError:
        return ()
    except OSError as error:
        raise AccessError(f"{path}: {error.strerror}") from error
    except (msgspec.DecodeError, UnicodeError) as error:
        raise AccessError(f"{path} cannot be read: {error}; remove it, and pair anew") from error


def keep_credential(credential: Credential) -> None:
    """Keep one, in place of an older one of that node; of too many the oldest goes. Raises AccessError."""
    path = credentials_path()
    others = [other for other in read_credentials() if other.node != credential.node]
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        with whole_file(path, private=True) as file:
            file.write(msgspec.json.encode(_File((*others[1 - CREDENTIALS_MAX :], credential))))
    except OSError as error:
        raise AccessError(f"{path}: {error.strerror}") from error


def find_credential(url: str, node: str | None = None) -> Credential | None:
    """That of a node, by its id where that is known, else by where it was. Raises AccessError."""
    for credential in reversed(read_credentials()):
        if credential.node == node if node else credential.url == url:
            return credential
    return None
