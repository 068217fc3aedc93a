"""Whether the node at the other end of a TLS line is the one we mean.

One that we paired with is known by the public key of its certificate, which outlives the certificate. A key that was
pinned is all that counts then: no authority, no name and no date. Others must have a certificate that this machine's
authorities vouch for, or show the fingerprint that the caller names.
"""

from __future__ import annotations

import asyncio
import hashlib
import ssl
from asyncio import Transport
from contextlib import suppress

import aiohttp
from cryptography import x509
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat
from yarl import URL

from client.errors import NodeLost, NodeNotTrusted
from protocol.errors import LocalWireError

HANDSHAKE_S = 10
SHUTDOWN_S = 1
SHA256_DIGITS = 64
WRONG_VERSION = "WRONG_VERSION_NUMBER"  # what OpenSSL says of an answer that is no TLS
UNTRUSTED = (aiohttp.ServerFingerprintMismatch, aiohttp.ClientConnectorCertificateError)


class KeyPin(aiohttp.Fingerprint):
    """For the `ssl` of aiohttp: takes a node only if its certificate holds the key with this SHA-256 (hex)."""

    def check(self, transport: Transport) -> None:
        """Raises ServerFingerprintMismatch, before anything is sent."""
        line = transport.get_extra_info("ssl_object")
        if line is None:
            return  # plain HTTP: aiohttp asks of every line
        got = bytes.fromhex(key_hash(line.getpeercert(binary_form=True)))
        if got != self.fingerprint:
            host, port, *_ = transport.get_extra_info("peername")
            raise aiohttp.ServerFingerprintMismatch(self.fingerprint, got, host, port)


def key_hash(certificate: bytes) -> str:
    """SHA-256 of the public key in a certificate (DER), hex."""
    key = x509.load_der_x509_certificate(certificate).public_key()
    return hashlib.sha256(key.public_bytes(Encoding.DER, PublicFormat.SubjectPublicKeyInfo)).hexdigest()


def certificate_pin(text: str) -> aiohttp.Fingerprint:
    """For the `ssl` of aiohttp: takes a node only if its certificate has this SHA-256. Raises LocalWireError."""
    digits = text.replace(":", "").replace(" ", "").lower()
    if len(digits) != SHA256_DIGITS or not set(digits) <= set("0123456789abcdef"):
        raise LocalWireError(f"{text[:100]!r} is no SHA-256 fingerprint of 64 hex digits, as `foveascan pair` prints")
    return aiohttp.Fingerprint(bytes.fromhex(digits))


async def look_at_certificate(host: str, port: int) -> tuple[bytes, bool]:
    """The certificate that is shown there (DER), and whether this machine's authorities vouch for it.

    Nothing is sent but the greetings of TLS. Raises NodeLost.
    """
    try:
        return await _shown(host, port, ssl.create_default_context()), True
    except ssl.SSLCertVerificationError:
        anyone = ssl.create_default_context()
        anyone.check_hostname, anyone.verify_mode = False, ssl.CERT_NONE
        return await _shown(host, port, anyone), False


async def _shown(host: str, port: int, context: ssl.SSLContext) -> bytes:
    try:
        async with asyncio.timeout(HANDSHAKE_S):
            _, writer = await asyncio.open_connection(
                host, port, ssl=context, server_hostname=host, ssl_shutdown_timeout=SHUTDOWN_S
            )
    except ssl.SSLCertVerificationError:
        raise
    except (OSError, TimeoutError) as error:
        raise NodeLost(f"no node with TLS at {host}:{port}: {error or 'no answer'}; check the address") from error
    certificate: bytes = writer.get_extra_info("ssl_object").getpeercert(binary_form=True)
    writer.close()
    with suppress(OSError, TimeoutError):  # whatever it has to say to that
        await writer.wait_closed()
    return certificate


def trouble(url: str, error: BaseException) -> NodeLost | NodeNotTrusted:
    """What ended a request, in our terms."""
    if isinstance(error, aiohttp.ServerFingerprintMismatch):
        return NodeNotTrusted(
            f"{url} shows another certificate than the one that was pinned: it is another node, or somebody is in "
            "between; if the node was set up anew, pair again with `foveascan join`"
        )
    if isinstance(error, aiohttp.ClientConnectorCertificateError):
        node = URL(url).origin()
        return NodeNotTrusted(f"{node} is not known here: pair with it, `foveascan join CODE --node {node}`")
    if other := other_scheme(url, error):
        return NodeLost(f"lost {url}: {other}")
    return NodeLost(f"lost {url}: {error or 'no answer in time'}; try again once the node is back")


def other_scheme(url: str, error: BaseException) -> str:
    """What to say where a node may serve TLS and was asked in plain HTTP, or the other way round; else ""."""
    node = URL(url).origin()
    if node.scheme == "http" and isinstance(error, aiohttp.ServerDisconnectedError):
        return f"it hung up; if it serves TLS, it is {node.with_scheme('https')}"
    if isinstance(error, aiohttp.ClientConnectorSSLError) and getattr(error.os_error, "reason", "") == WRONG_VERSION:
        return f"it does not serve TLS; a node started with --insecure is {node.with_scheme('http')}"
    return ""
