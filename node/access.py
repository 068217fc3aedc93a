"""Who may come in: tokens and pairing codes, in one private file that the daemon and the commands beside it share.

Tokens are kept as SHA-256 (they have 256 random bits, so nothing slower is needed), codes as the key of their proofs.
Whoever changes the file holds a lock; whoever reads it notices by its inode that another process wrote it anew.
"""

from __future__ import annotations

import fcntl
import hashlib
import hmac
import os
import secrets
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import msgspec
from msgspec import Meta, Struct
from msgspec.structs import replace

from node.durable import give_to_owner_of, make_private_folder, read_bounded, write_whole
from node.last_used import LastUsed
from protocol import pairing
from protocol.errors import AccessError, LibraryError

FOLDER, FILE, LOCK_FILE = "access", "access.json", "lock"
FILE_BYTES_MAX = 1 << 20
TOKENS_MAX = 1000
CODES_MAX = 20
CODE_VALID_S = 600.0
CODE_VALID_MAX_S = 3600.0
TOKEN_BYTES = 32


class Token(Struct, frozen=True):
    """A token that stands. digest : SHA-256 of its text."""

    name: pairing.Name
    role: pairing.Role
    digest: pairing.Hex256
    created_unix_s: float


class Code(Struct, frozen=True):
    """A pairing code that waits. key : `pairing.key_of` it, in hex."""

    name: pairing.Name
    role: pairing.Role
    key: pairing.Hex256
    expires_unix_s: float


class _Record(Struct, frozen=True):
    format: Annotated[int, Meta(ge=1, le=1)] = 1
    tokens: Annotated[tuple[Token, ...], Meta(max_length=TOKENS_MAX)] = ()
    codes: Annotated[tuple[Code, ...], Meta(max_length=CODES_MAX)] = ()


def access_folder(library: Path) -> Path:
    """Where a node keeps its certificate and who may come in; made if need be. Raises AccessError."""
    folder = library / FOLDER
    try:
        make_private_folder(folder)
        if folder.stat().st_mode & 0o077:
            raise AccessError(f"{folder} is open to others: chmod 700 {folder}")
    except OSError as error:
        raise AccessError(f"{folder}: {error.strerror}") from error
    return folder


class Access:
    """The tokens and codes kept in a folder (see `access_folder`). All methods raise AccessError."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / FILE
        self._lock = folder / LOCK_FILE
        self._seen: tuple[int, int] | None = None
        self._record = _Record()
        self.last_used = LastUsed(folder)
        self.tokens()

    def tokens(self) -> tuple[Token, ...]:
        """All that stand, oldest first."""
        return self._current().tokens

    def codes(self, now_s: float) -> tuple[Code, ...]:
        """All that wait, oldest first."""
        return _valid(self._current().codes, now_s)

    def keep_last_used(self) -> None:
        """Write down when tokens were used, as far as that is new."""
        self.last_used.keep({token.digest for token in self.tokens()})

    def find(self, text: str) -> Token | None:
        """The token whose text this is; takes as long for any other text."""
        digest = _digest(text)
        found = None
        for token in self.tokens():
            if hmac.compare_digest(token.digest, digest):
                found = token
        return found

    def offer(self, role: pairing.Role, name: str, now_s: float, valid_s: float = CODE_VALID_S) -> str:
        """A new code for whoever is to be called `name`, as people read it."""
        code = secrets.token_bytes(pairing.CODE_BYTES)
        offered = Code(_checked(name), role, pairing.key_of(code).hex(), now_s + min(valid_s, CODE_VALID_MAX_S))
        with self._changing() as record:
            waiting = tuple(other for other in _valid(record.codes, now_s) if other.name != name)
            if any(token.name == name for token in record.tokens):
                raise AccessError(f"{name!r} is paired already: foveascan access revoke {name!r}, or another name")
            if len(record.tokens) >= TOKENS_MAX or len(waiting) >= CODES_MAX:
                raise AccessError("too many are paired or waiting: revoke some first")
            self._write(replace(record, codes=(*waiting, offered)))
        return pairing.code_text(code)

    def awaits(self, name: str, now_s: float) -> bool:
        """Whether a code waits for whoever is to be called so, which another would replace."""
        return any(code.name == name for code in _valid(self._current().codes, now_s))

    def grant(self, role: pairing.Role, name: str, now_s: float) -> str:
        """A token at once, for a program that cannot join; its text, which is kept nowhere."""
        key = pairing.key_of(pairing.parse_code(self.offer(role, name, now_s)))
        made = self.redeem(lambda other: hmac.compare_digest(other, key), now_s)
        if made is None:
            raise AccessError(f"{name!r} was paired by somebody else at this moment: try again")
        return made[0]

    def redeem(self, is_proven: Callable[[bytes], bool], now_s: float) -> tuple[str, Token, bytes] | None:
        """Make a token of the code that is proven, which is gone then; None when none is.

        is_proven : told the key of each code.  Returns the token's text, the token, and the code's key.
        """
        if not any([is_proven(bytes.fromhex(code.key)) for code in _valid(self._current().codes, now_s)]):
            return None
        with self._changing() as record:  # anew: another process may have been faster
            for code in _valid(record.codes, now_s):
                if is_proven(bytes.fromhex(code.key)):
                    text = secrets.token_urlsafe(TOKEN_BYTES)
                    token = Token(code.name, code.role, _digest(text), now_s)
                    left = tuple(other for other in record.codes if other is not code)
                    self._write(replace(record, tokens=(*record.tokens, token), codes=left))
                    return text, token, bytes.fromhex(code.key)
        return None

    def revoke(self, name: str) -> bool:
        """End a token, or a code that waits. False when nobody has that name."""
        with self._changing() as record:
            tokens = tuple(token for token in record.tokens if token.name != name)
            codes = tuple(code for code in record.codes if code.name != name)
            self._write(replace(record, tokens=tokens, codes=codes))
            return len(tokens) + len(codes) < len(record.tokens) + len(record.codes)

    def void_codes(self) -> int:
        """End every code that waits; how many did."""
        with self._changing() as record:
            self._write(replace(record, codes=()))
            return len(record.codes)

    def _current(self) -> _Record:
        try:
            status = self._path.stat()
        except FileNotFoundError:
            return _Record()  # nobody was ever paired, or somebody took the file away: nobody comes in
        except OSError as error:
            raise AccessError(f"{self._path}: {error.strerror}") from error
        mark = status.st_ino, status.st_mtime_ns
        if mark != self._seen:
            self._record, self._seen = self._read(), mark
        return self._record

    def _read(self) -> _Record:
        try:
            return msgspec.json.decode(read_bounded(self._path, FILE_BYTES_MAX), type=_Record)
        except (OSError, msgspec.DecodeError, UnicodeError, LibraryError) as error:
            raise AccessError(f"{self._path} cannot be used: {error}; remove it, and pair everybody anew") from error

    @contextmanager
    def _changing(self) -> Iterator[_Record]:
        """The record as it is now, while nobody else can change it."""
        try:
            handle = os.open(self._lock, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
            try:
                give_to_owner_of(self._lock.parent, self._lock)
                fcntl.flock(handle, fcntl.LOCK_EX)
                yield self._current()
            finally:
                os.close(handle)
        except OSError as error:
            raise AccessError(f"{self._lock.parent}: {error.strerror}") from error

    def _write(self, record: _Record) -> None:
        write_whole(self._path, msgspec.json.encode(record) + b"\n", private=True)


def _valid(codes: tuple[Code, ...], now_s: float) -> tuple[Code, ...]:
    """Those that have not expired; a clock that was set back makes none last longer than any may."""
    return tuple(code for code in codes if 0 < code.expires_unix_s - now_s <= CODE_VALID_MAX_S)


def _checked(name: str) -> str:
    try:
        return msgspec.convert(name, pairing.Name)
    except msgspec.ValidationError:
        raise AccessError("a name has 1 to 60 characters, none of them a control character") from None


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode(errors="replace")).hexdigest()
