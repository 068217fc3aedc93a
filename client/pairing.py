"""Pairing with a node: prove a code, over the certificate that we see, and keep the token and the node's key."""

from __future__ import annotations

import hmac
import secrets

import aiohttp
import msgspec
from yarl import URL

from client.credentials import Credential, keep_credential
from client.discovery import NodeAddress
from client.errors import NodeLost, NodeNotTrusted
from client.rest import ask
from client.trust import certificate_pin, key_hash, look_at_certificate
from protocol import pairing
from protocol.errors import RemoteWireError

NONCE_BYTES = 16


async def pair(node: NodeAddress | str, code: str) -> Credential:
    """Become known to a node with a code of `foveascan pair`. What comes of it is kept for `connect`.

    Whoever stands in between has another certificate, so the node refuses, and he learns nothing of the code.
    Raises LocalWireError for what is no code, RequestRefused, NodeLost, NodeNotTrusted, RemoteWireError, AccessError.
    """
    key = pairing.key_of(pairing.parse_code(code))
    url = node.url if isinstance(node, NodeAddress) else node.rstrip("/")
    host, port = _place(url)
    certificate, is_vouched = await look_at_certificate(host, port)
    seen, nonce = pairing.fingerprint(certificate), secrets.token_hex(NONCE_BYTES)
    request = pairing.PairRequest(nonce, pairing.client_proof(key, seen, nonce))
    connector = aiohttp.TCPConnector(ssl=certificate_pin(seen))
    async with aiohttp.ClientSession(connector=connector) as http:
        said = await ask(http, "POST", f"{url}/v1/pair", request)
    paired = _checked(said, key, seen, nonce)
    credential = Credential(
        paired.node, url, paired.name, paired.role, paired.token, "" if is_vouched else key_hash(certificate)
    )
    keep_credential(credential)
    return credential


def _place(url: str) -> tuple[str, int]:
    """Host and port. Raises NodeLost."""
    try:
        parsed = URL(url)
        if parsed.scheme == "https" and parsed.host and parsed.port:
            return parsed.host, parsed.port
    except ValueError:
        pass
    raise NodeLost(f"{url!r} cannot be paired with: use https://HOST:PORT of a node; with --insecure it needs no login")


def _checked(said: object, key: bytes, seen: str, nonce: str) -> pairing.Paired:
    """The answer, if it comes from whoever made the code. Raises RemoteWireError, NodeNotTrusted."""
    try:
        paired = msgspec.convert(said, pairing.Paired)
    except msgspec.ValidationError as error:
        raise RemoteWireError(f"a bad answer to pairing: {error}") from None
    if not hmac.compare_digest(paired.proof, pairing.node_proof(key, seen, nonce, paired.token, paired.role)):
        raise NodeNotTrusted("whoever answered does not know the code: it is not the node that printed it")
    return paired
