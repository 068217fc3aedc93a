"""Pairing with a node: prove a code, over the certificate that we see, and keep the token and the node's key."""

from __future__ import annotations

import hmac
import secrets

import aiohttp

from client.credentials import Credential, keep_credential
from client.discovery import NodeAddress, located
from client.errors import NodeLost, NodeNotTrusted
from client.rest import ask, checked
from client.trust import certificate_pin, key_hash, look_at_certificate
from protocol import pairing

NONCE_BYTES = 16


async def pair(node: NodeAddress | str, code: str) -> Credential:
    """Become known to a node with a code of `foveascan pair`. What comes of it is kept for `connect`.

    Whoever stands in between has another certificate, so the node refuses, and he learns nothing of the code.
    Raises LocalWireError for what is no code, RequestRefused, NodeLost, NodeNotTrusted, RemoteWireError, AccessError.
    """
    key = pairing.key_of(pairing.parse_code(code))
    url, parts = located(node)
    if parts.scheme != "https" or not parts.host or not parts.port:
        raise NodeLost(f"{url!r} cannot be paired with: use https://HOST:PORT; a node with --insecure needs no login")
    certificate, is_vouched = await look_at_certificate(parts.host, parts.port)
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


def _checked(said: object, key: bytes, seen: str, nonce: str) -> pairing.Paired:
    """The answer, if it comes from whoever made the code. Raises RemoteWireError, NodeNotTrusted."""
    paired = checked(said, pairing.Paired, "a bad answer to pairing")
    if not hmac.compare_digest(paired.proof, pairing.node_proof(key, seen, nonce, paired.token, paired.role)):
        raise NodeNotTrusted("whoever answered does not know the code: it is not the node that printed it")
    return paired
