"""The node's certificate: a clinic's own, or one the node makes for itself, renewed before it ends.

Key and certificate of the node's own lie in one private file, so that they change together. Renewal keeps the key,
since that is what paired clients know the node by.
"""

from __future__ import annotations

import datetime as dt
import os
import socket
import ssl
from ipaddress import ip_address
from pathlib import Path

from cryptography import x509
from cryptography.exceptions import UnsupportedAlgorithm
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.asymmetric.types import CertificateIssuerPrivateKeyTypes
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from node.config import Server
from node.durable import read_bounded, write_whole
from protocol.errors import AccessError, LibraryError
from protocol.pairing import fingerprint

FILE = "certificate.pem"
FILE_BYTES_MAX = 1 << 16
VALID = dt.timedelta(days=800)  # Apple's devices take at most 825
RENEW_BEFORE = dt.timedelta(days=60)
CLOCK_SLACK = dt.timedelta(days=1)
NAME_MAX = 64
CREDENTIAL = "credential:"


class Tls:
    """What the server shows to clients. context : for its sockets; fingerprint : SHA-256 of the certificate, hex.

    ends_unix_s : when that ends.

    folder : of `node.access`; node_id : names the certificate. Raises AccessError.
    """

    def __init__(self, server: Server, folder: Path, node_id: str) -> None:
        self._server = server
        self._folder = folder
        self._node_id = node_id
        self.context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        self.context.minimum_version = ssl.TLSVersion.TLSv1_2
        self.context.set_alpn_protocols(["http/1.1"])
        self.fingerprint = ""
        self.ends_unix_s = 0.0
        self.refresh()

    def refresh(self) -> bool:
        """Renew what is due and take what was changed, for connections to come. Whether there was anything."""
        if self._server.certificate is None:
            renew_own(self._folder, self._node_id, self._server.host, dt.datetime.now(dt.UTC))
        certificate, key = certificate_file(self._server, self._folder), key_file(self._server, self._folder)
        shown = certificate_fingerprint(certificate)
        self.ends_unix_s = read_certificate(certificate).not_valid_after_utc.timestamp()
        if shown == self.fingerprint:
            return False
        try:
            for context in (ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER), self.context):  # a trial spoils only itself
                context.load_cert_chain(certificate, key)
        except (OSError, ssl.SSLError) as error:
            raise AccessError(f"{certificate} and {key} cannot be used: {error.strerror or error}") from error
        self.fingerprint = shown
        return True

    @property
    def is_own(self) -> bool:
        """Whether the node made its certificate itself, and renews it."""
        return self._server.certificate is None

    def use(self, server: Server) -> None:
        """Take other settings; where they cannot be used, nothing changes. Raises AccessError."""
        before, self._server = self._server, server
        try:
            self.refresh()
        except AccessError:
            self._server = before
            raise


def certificate_file(server: Server, folder: Path) -> Path:
    """Where the certificate is."""
    return folder / FILE if server.certificate is None else Path(server.certificate)


def key_file(server: Server, folder: Path) -> Path:
    """Where its key is. Raises AccessError for a credential that systemd did not hand over (systemd.exec(5))."""
    key = server.key
    if key is None or not key.startswith(CREDENTIAL):
        return folder / FILE if key is None else Path(key)
    name, handed = key.removeprefix(CREDENTIAL), os.environ.get("CREDENTIALS_DIRECTORY")
    if handed is None:
        raise AccessError(f"server.key: no credentials here: only a service that loads {name!r} can read it")
    if "/" in name or not (path := Path(handed, name)).is_file():
        raise AccessError(f"server.key: no credential {name!r} was handed over: put it in /etc/credstore, and restart")
    return path


def read_certificate(path: Path) -> x509.Certificate:
    """The first certificate of a PEM file. Raises AccessError."""
    try:
        return x509.load_pem_x509_certificate(read_bounded(path, FILE_BYTES_MAX))
    except OSError as error:
        raise AccessError(f"{path}: {error.strerror}") from error
    except (ValueError, LibraryError) as error:
        raise AccessError(f"{path} holds no certificate: {error}") from error


def certificate_fingerprint(path: Path) -> str:
    """SHA-256 of it, in hex. Raises AccessError."""
    return fingerprint(read_certificate(path).public_bytes(serialization.Encoding.DER))


def renew_own(folder: Path, node_id: str, host: str, now: dt.datetime) -> None:
    """Make the node's own certificate where there is none, or one that ends soon. Raises AccessError."""
    path = folder / FILE
    if not path.exists():
        _make(path, ec.generate_private_key(ec.SECP256R1()), node_id, host, now)
        return
    current = read_certificate(path)
    if not current.not_valid_before_utc <= now < current.not_valid_after_utc - RENEW_BEFORE:
        _make(path, _read_key(path), node_id, host, now)


def _make(path: Path, key: CertificateIssuerPrivateKeyTypes, node_id: str, host: str, now: dt.datetime) -> None:
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, f"foveascan {node_id}"[:NAME_MAX])])
    certificate = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - CLOCK_SLACK)
        .not_valid_after(now - CLOCK_SLACK + VALID)
        .add_extension(x509.SubjectAlternativeName(_names(node_id, host)), critical=False)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH]), critical=False)
        .sign(key, hashes.SHA256())
    )
    pem = serialization.Encoding.PEM
    secret = key.private_bytes(pem, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    try:
        write_whole(path, secret + certificate.public_bytes(pem), private=True)
    except OSError as error:
        raise AccessError(f"{path}: {error.strerror}") from error


def _read_key(path: Path) -> CertificateIssuerPrivateKeyTypes:
    try:
        key = serialization.load_pem_private_key(read_bounded(path, FILE_BYTES_MAX), None)
    except OSError as error:
        raise AccessError(f"{path}: {error.strerror}") from error
    except (ValueError, TypeError, UnsupportedAlgorithm, LibraryError) as error:
        raise AccessError(f"{path} holds no key: {error}; remove it, and pair everybody anew") from error
    if not isinstance(key, ec.EllipticCurvePrivateKey):
        raise AccessError(f"{path} holds a key that this node did not make; remove it, or set server.certificate")
    return key


def _names(node_id: str, host: str) -> list[x509.GeneralName]:
    """What clients may call the node by: its name on this network, this host, and the address it listens at."""
    names: list[x509.GeneralName] = [x509.DNSName(f"foveascan-{node_id}.local"), x509.DNSName("localhost")]
    hostname = socket.gethostname()
    if hostname.isascii() and hostname != "localhost":
        names.append(x509.DNSName(hostname))
    try:
        address = ip_address(host)
    except ValueError:
        return names
    return names if address.is_unspecified else [*names, x509.IPAddress(address)]
