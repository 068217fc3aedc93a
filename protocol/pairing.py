"""How a client gets its token: what node and client must compute alike, and the two messages between them.

A pairing code is 80 random bits that a person carries from the node to the client. The client does not send it: it
sends an HMAC, keyed by the code, over the fingerprint of the certificate that its TLS connection shows. Whoever stands
between the two shows a certificate of his own, so what he passes on proves nothing to the node. The node answers with
an HMAC of its own, over the token too, which nobody can make who does not know the code.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import hmac
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from protocol.errors import LocalWireError

CODE_BYTES = 10
GROUP = 4  # letters between hyphens
CONTEXT = b"foveascan pairing 1"

Role = Literal["monitor", "view", "operate", "admin"]
"""What a token lets its owner do; each includes the one before. monitor : see how the node is, and no scan."""
Hex128 = Annotated[str, Meta(pattern="^[0-9a-f]{32}$")]
Hex256 = Annotated[str, Meta(pattern="^[0-9a-f]{64}$")]
Name = Annotated[  # "$" instead of the last group would let a newline at the end in
    str, Meta(min_length=1, max_length=60, pattern="^[^\\x00-\\x1f\\x7f-\\x9f]+(?![\\s\\S])")
]


class PairRequest(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Body of POST /v1/pair: `nonce` is drawn by the client, `proof` is `client_proof`."""

    nonce: Hex128
    proof: Hex256


class Paired(msgspec.Struct, frozen=True):
    """The answer. node : the node's id; proof : `node_proof`."""

    token: Annotated[str, Meta(min_length=20, max_length=100)]
    name: Name
    role: Role
    node: Annotated[str, Meta(max_length=200)]
    proof: Hex256


def code_text(code: bytes) -> str:
    """A code as people read it: ABCD-EFGH-IJKL-MNOP."""
    letters = base64.b32encode(code).decode()
    return "-".join(letters[at : at + GROUP] for at in range(0, len(letters), GROUP))


def parse_code(text: str) -> bytes:
    """The code that somebody typed, in either case, with or without hyphens and blanks. Raises LocalWireError."""
    letters = "".join(text.upper().replace("-", "").split())
    try:
        code = base64.b32decode(letters)
    except (binascii.Error, ValueError):
        code = b""
    if len(code) != CODE_BYTES:
        raise LocalWireError("that is no pairing code: it has 16 letters and digits, as `foveascan pair` prints them")
    return code


def key_of(code: bytes) -> bytes:
    """What proofs are keyed with; a node keeps this, not the code."""
    return hashlib.sha256(CONTEXT + code).digest()


def fingerprint(certificate: bytes) -> str:
    """SHA-256 of a certificate in DER, as 64 hex digits."""
    return hashlib.sha256(certificate).hexdigest()


def fingerprint_text(digits: str) -> str:
    """A fingerprint as browsers show it: AB:CD:..."""
    return ":".join(digits[at : at + 2] for at in range(0, len(digits), 2)).upper()


def client_proof(key: bytes, seen: str, nonce: str) -> str:
    """That the client knows the code, over the fingerprint it sees."""
    return _proof(key, "client", seen, nonce)


def node_proof(key: bytes, own: str, nonce: str, token: str, role: Role) -> str:
    """That the node knows the code, over its own fingerprint and what it gives."""
    return _proof(key, "node", own, nonce, token, role)


def _proof(key: bytes, *said: str) -> str:
    return hmac.new(key, CONTEXT + b"\n" + "\n".join(said).encode(), hashlib.sha256).hexdigest()
