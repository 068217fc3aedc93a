from __future__ import annotations

import datetime as dt
import ssl
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives.serialization import Encoding

from client.trust import key_hash
from node.config import Server
from node.tls import FILE, RENEW_BEFORE, VALID, Tls, certificate_fingerprint, read_certificate, renew_own
from protocol.errors import AccessError

NOW = dt.datetime(2026, 11, 22, tzinfo=dt.UTC)


def key_of(folder: Path) -> str:
    return key_hash(read_certificate(folder / FILE).public_bytes(Encoding.DER))


def test_the_first_start_makes_a_certificate_that_later_starts_keep(tmp_path: Path) -> None:
    first = Tls(Server(), tmp_path, "1234")
    assert Tls(Server(), tmp_path, "1234").fingerprint == first.fingerprint == certificate_fingerprint(tmp_path / FILE)
    assert (tmp_path / FILE).stat().st_mode & 0o077 == 0
    assert not first.refresh()


def test_it_names_the_node_and_the_address_it_listens_at(tmp_path: Path) -> None:
    renew_own(tmp_path, "1234", "192.168.1.7", NOW)
    names = read_certificate(tmp_path / FILE).extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert {"foveascan-1234.local", "localhost"} <= set(names.get_values_for_type(x509.DNSName))
    assert [str(ip) for ip in names.get_values_for_type(x509.IPAddress)] == ["192.168.1.7"]


@pytest.mark.parametrize("later", [VALID - RENEW_BEFORE, VALID * 3, dt.timedelta(days=-400)])
def test_one_that_ends_soon_or_is_not_valid_is_renewed_with_the_same_key(tmp_path: Path, later: dt.timedelta) -> None:
    renew_own(tmp_path, "1234", "::1", NOW)
    before, key = certificate_fingerprint(tmp_path / FILE), key_of(tmp_path)
    renew_own(tmp_path, "1234", "::1", NOW + later)
    assert certificate_fingerprint(tmp_path / FILE) != before
    assert key_of(tmp_path) == key
    certificate = read_certificate(tmp_path / FILE)
    assert certificate.not_valid_before_utc <= NOW + later < certificate.not_valid_after_utc - RENEW_BEFORE


def test_a_key_may_be_a_credential_that_systemd_hands_over(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    renew_own(tmp_path, "clinic", "::1", NOW)
    handed = tmp_path / "credentials"
    handed.mkdir()
    server = Server(certificate=str(tmp_path / FILE), key="credential:foveascan.key")
    monkeypatch.delenv("CREDENTIALS_DIRECTORY", raising=False)
    with pytest.raises(AccessError, match=r"^server\.key: no credentials here"):
        Tls(server, tmp_path, "1234")
    monkeypatch.setenv("CREDENTIALS_DIRECTORY", str(handed))
    with pytest.raises(AccessError, match=r"^server\.key: no credential 'foveascan.key' was handed over"):
        Tls(server, tmp_path, "1234")
    (handed / "foveascan.key").write_bytes((tmp_path / FILE).read_bytes())
    assert Tls(server, tmp_path, "1234").fingerprint == certificate_fingerprint(tmp_path / FILE)
    with pytest.raises(AccessError, match="no credential"):
        Tls(Server(certificate=str(tmp_path / FILE), key=f"credential:../{FILE}"), tmp_path, "1234")


def test_settings_that_cannot_be_used_change_nothing(tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        renew_own(tmp_path / name, name, "::1", NOW)
    a, b = (str(tmp_path / name / FILE) for name in ("a", "b"))
    tls = Tls(Server(certificate=a, key=a), tmp_path, "1234")
    for wrong in (Server(certificate=b, key=a), Server(certificate=b, key=str(tmp_path / "none"))):
        with pytest.raises(AccessError, match="cannot be used"):
            tls.use(wrong)
        assert tls.fingerprint == certificate_fingerprint(Path(a)) and not tls.refresh()
    tls.use(Server(certificate=b, key=b))
    assert tls.fingerprint == certificate_fingerprint(Path(b))


def test_a_clinics_own_certificate_is_shown_and_its_renewal_taken_up(tmp_path: Path) -> None:
    renew_own(tmp_path, "clinic", "::1", NOW)
    theirs = tmp_path / FILE
    (tmp_path / "access").mkdir()
    tls = Tls(Server(certificate=str(theirs), key=str(theirs)), tmp_path / "access", "1234")
    assert tls.fingerprint == certificate_fingerprint(theirs)
    assert not list((tmp_path / "access").iterdir())
    theirs.unlink()
    renew_own(tmp_path, "clinic", "::1", NOW)
    assert tls.refresh()
    assert tls.fingerprint == certificate_fingerprint(theirs)


def test_files_that_are_none_are_named(tmp_path: Path) -> None:
    (tmp_path / "c.pem").write_text("nothing")
    for certificate in ("c.pem", "missing.pem"):
        with pytest.raises(AccessError, match=certificate):
            Tls(Server(certificate=str(tmp_path / certificate), key=str(tmp_path / "c.pem")), tmp_path, "1234")
    renew_own(tmp_path, "1234", "::1", NOW)
    with pytest.raises(AccessError, match="cannot be used"):
        Tls(Server(certificate=str(tmp_path / FILE), key=str(tmp_path / "c.pem")), tmp_path, "1234")


def test_old_versions_of_tls_are_refused(tmp_path: Path) -> None:
    assert Tls(Server(), tmp_path, "1234").context.minimum_version >= ssl.TLSVersion.TLSv1_2
