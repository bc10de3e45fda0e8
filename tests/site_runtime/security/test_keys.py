"""Certificates as they are made, renewed and revoked, and what of them is refused at the start."""

import os
import shutil
import stat
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.x509.oid import ExtendedKeyUsageOID

from site_runtime.security.authority import Authority, create_authority, open_authority
from site_runtime.security.credentials import (
    ALLOWED_FILE,
    AUTHORITY_FILE,
    CERTIFICATE_FILE,
    KEY_FILE,
    load_credentials,
    read_allowed,
    read_credentials,
)
from site_runtime.security.identity import AUTHORITY, Identity, Role, SecurityError, named

LOCAL, REMOTE, EYE = Identity("local"), Identity("remote"), Identity("eye")


@pytest.fixture
def authority(tmp_path: Path) -> Authority:
    authority = create_authority(tmp_path / "keys", "trial")
    for identity in (LOCAL, REMOTE, EYE):
        authority.issue(identity, ["127.0.0.1", "arm.example"])
    return authority


def certificate(authority: Authority, name: str) -> x509.Certificate:
    return x509.load_pem_x509_certificate((authority.folder / name / CERTIFICATE_FILE).read_bytes())


def refused(authority: Authority, identity: Identity = REMOTE) -> str:
    with pytest.raises(SecurityError) as caught:
        load_credentials(authority.folder, identity)
    return str(caught.value)


def test_everything_is_closed_to_others(authority: Authority) -> None:
    for path in (authority.folder, *authority.folder.rglob("*")):
        assert stat.S_IMODE(path.stat().st_mode) == (0o700 if path.is_dir() else 0o600), path


def test_a_folder_has_all_its_party_needs_and_nothing_of_others(authority: Authority) -> None:
    found = {path.name for path in (authority.folder / "remote").iterdir()}
    assert found == {AUTHORITY_FILE, CERTIFICATE_FILE, KEY_FILE, ALLOWED_FILE}
    keys = {path.read_bytes() for path in authority.folder.rglob(KEY_FILE)}
    assert len(keys) == 4


def test_a_certificate_says_who_it_is_where_and_for_how_long(authority: Authority) -> None:
    site, observer = certificate(authority, "remote"), certificate(authority, "eye")
    assert site.subject.rfc4514_string() == "CN=remote-1"
    assert observer.subject.rfc4514_string() == "CN=observer.eye-1"
    hosts = site.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert [str(name.value) for name in hosts] == ["127.0.0.1", "arm.example"]
    life = site.not_valid_after_utc - datetime.now(UTC)
    assert timedelta(days=364) < life <= timedelta(days=365)
    signer = certificate(authority, "remote").extensions
    assert not signer.get_extension_for_class(x509.BasicConstraints).value.ca


def test_nobody_passes_for_a_site_with_an_observers_certificate(authority: Authority) -> None:
    extensions = certificate(authority, "eye").extensions
    usage = extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
    assert list(usage) == [ExtendedKeyUsageOID.CLIENT_AUTH]
    with pytest.raises(x509.ExtensionNotFound):
        extensions.get_extension_for_class(x509.SubjectAlternativeName)


def test_good_credentials_are_taken(authority: Authority) -> None:
    credentials = load_credentials(authority.folder, REMOTE)
    assert credentials.common_name == "remote-1"
    assert credentials.names_allowed() == {
        LOCAL: "local-1",
        REMOTE: "remote-1",
        EYE: "observer.eye-1",
    }


def test_a_renewal_keeps_the_name_and_the_hosts_and_changes_the_key(authority: Authority) -> None:
    before = read_credentials(authority.folder, REMOTE)
    key = (before.folder / KEY_FILE).read_bytes()
    assert open_authority(authority.folder).issue(REMOTE, ["10.0.0.2"]) == "remote-1"
    after = load_credentials(authority.folder, REMOTE)
    assert after.fingerprint != before.fingerprint
    assert (after.folder / KEY_FILE).read_bytes() != key
    assert after.hosts == ("127.0.0.1", "arm.example", "10.0.0.2")


def test_a_revoked_name_is_allowed_nowhere_and_its_successor_everywhere(
    authority: Authority,
) -> None:
    assert authority.revoke(REMOTE) == "remote-1"
    for name in ("local", "remote", "eye"):
        allowed = read_allowed(authority.folder / name / ALLOWED_FILE)
        assert set(allowed) == {"local-1", "observer.eye-1"}
    assert "remote-1 is revoked" in refused(authority)

    again = open_authority(authority.folder)
    again.revoke(REMOTE)  # twice is once
    assert again.issue(REMOTE, ()) == "remote-2"
    for name in ("local", "remote", "eye"):
        allowed = read_allowed(authority.folder / name / ALLOWED_FILE)
        assert set(allowed) == {"local-1", "remote-2", "observer.eye-1"}
    load_credentials(authority.folder, REMOTE)


def test_what_was_never_made_cannot_be_revoked(authority: Authority) -> None:
    with pytest.raises(SecurityError, match="router"):
        authority.revoke(Identity("router"))


def test_an_authority_is_not_overwritten_and_not_used_without_its_key(authority: Authority) -> None:
    with pytest.raises(SecurityError, match="already"):
        create_authority(authority.folder, "again")
    shutil.rmtree(authority.folder / AUTHORITY)
    with pytest.raises(SecurityError, match="only the machine that keeps"):
        open_authority(authority.folder)


def test_an_expired_certificate_is_refused(authority: Authority) -> None:
    authority.issue(REMOTE, (), life=timedelta(seconds=-1))
    assert "expired" in (said := refused(authority))
    assert "farhand keys renew" in said


def test_one_of_the_future_points_at_the_clock(
    authority: Authority, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("site_runtime.security.authority.CLOCK_SKEW", timedelta(hours=-2))
    authority.issue(REMOTE, ())
    assert "clock" in refused(authority)


@pytest.mark.parametrize("name", [".", KEY_FILE])
@pytest.mark.parametrize("mode", [0o750, 0o604])
def test_what_others_may_read_is_refused(authority: Authority, name: str, mode: int) -> None:
    path = authority.folder / "remote" / name
    path.chmod(mode | 0o100 if path.is_dir() else mode)
    said = refused(authority)
    assert "open to others" in said
    assert "chmod" in said


def test_the_certificate_of_another_party_is_refused(authority: Authority) -> None:
    folder = authority.folder
    shutil.rmtree(folder / "remote")
    shutil.copytree(folder / "local", folder / "remote")
    assert "certificate of local, not of remote" in refused(authority)


def test_a_key_that_is_another_certificates_is_refused(authority: Authority) -> None:
    folder = authority.folder
    shutil.copy(folder / "local" / KEY_FILE, folder / "remote" / KEY_FILE)
    assert "not the key" in refused(authority)


def test_a_certificate_of_another_authority_is_refused(
    authority: Authority, tmp_path: Path
) -> None:
    other = create_authority(tmp_path / "other", "trial")
    other.issue(REMOTE, ())
    shutil.copy(tmp_path / "other" / "remote" / AUTHORITY_FILE, authority.folder / "remote")
    assert "not signed" in refused(authority)


@pytest.mark.parametrize("name", [AUTHORITY_FILE, CERTIFICATE_FILE, KEY_FILE, ALLOWED_FILE])
@pytest.mark.parametrize("broken", [None, b"", b"{}", b"\xff\xfe"])
def test_a_missing_or_broken_file_is_named(
    authority: Authority, name: str, broken: bytes | None
) -> None:
    path = authority.folder / "remote" / name
    if broken is None:
        path.unlink()
    else:
        path.write_bytes(broken)
    assert name in refused(authority)


def test_a_folder_that_is_not_there_says_how_to_make_it(tmp_path: Path) -> None:
    with pytest.raises(SecurityError, match="farhand keys"):
        load_credentials(tmp_path, REMOTE)


@pytest.mark.parametrize("name", ["", "authority", "../remote", "Remote", "a b", "x" * 33, "-x"])
def test_what_cannot_name_a_party(name: str) -> None:
    with pytest.raises(SecurityError):
        Identity(name)


@pytest.mark.parametrize(
    "name", ["", "remote", "remote-0", "remote-01", "observer.remote-1", "eye-1", "authority-1"]
)
def test_what_no_certificate_is_called(name: str) -> None:
    with pytest.raises(SecurityError):
        named(name)


def test_names_read_back() -> None:
    for text in ("local", "remote", "router", "eye", "eye-2"):
        identity = Identity(text)
        assert named(identity.common_name(12)) == (identity, 12)
    assert Identity("eye").role is Role.OBSERVER


def test_a_write_that_fails_leaves_what_was_there(
    authority: Authority, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = read_allowed(authority.folder / "local" / ALLOWED_FILE)

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="space"):
        authority.revoke(REMOTE)
    assert read_allowed(authority.folder / "local" / ALLOWED_FILE) == before
    assert {path.name for path in (authority.folder / AUTHORITY).iterdir()} == {
        AUTHORITY_FILE,
        KEY_FILE,
        "issued.json",
    }
