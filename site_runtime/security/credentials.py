"""One identity's folder: its certificate and private key, the authority's, and who is allowed.

Everything that one machine needs is in one folder, to be copied there as it is.
"""

import json
import os
import stat
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from site_runtime.security.identity import Identity, SecurityError, named

AUTHORITY_FILE = "authority.pem"
CERTIFICATE_FILE = "certificate.pem"
KEY_FILE = "private_key.pem"
ALLOWED_FILE = "allowed.json"
NEAR = timedelta(days=30)
"""Left of a certificate when it is time to renew it."""


@dataclass(frozen=True, slots=True)
class Credentials:
    """What an identity shows, and whom it lets speak: paths for Zenoh, common names."""

    identity: Identity
    generation: int
    folder: Path
    allowed: tuple[str, ...]
    expires: datetime
    fingerprint: str
    hosts: tuple[str, ...]

    @property
    def common_name(self) -> str:
        """Name in the certificate."""
        return self.identity.common_name(self.generation)

    @property
    def revoked(self) -> bool:
        """Whether its own list does not allow it."""
        return self.common_name not in self.allowed

    def left(self) -> timedelta:
        """Time until the certificate expires, negative after."""
        return self.expires - datetime.now(UTC)

    def file(self, name: str) -> str:
        """Absolute path of one of its files."""
        return str(self.folder / name)

    def names_allowed(self) -> dict[Identity, str]:
        """Return the common name of every identity that is allowed."""
        return {named(name)[0]: name for name in self.allowed}


def load_credentials(folder: Path, identity: Identity) -> Credentials:
    """Read and check an identity's folder; SecurityError says what is wrong and what to do.

    Checked: all files there, folder and key closed to others, certificate of this identity, signed
    by the authority beside it, valid now, made for this key, and allowed.
    """
    credentials = read_credentials(folder, identity)
    place = credentials.folder
    require_private(place)
    require_private(place / KEY_FILE)
    certificate = load_certificate(place / CERTIFICATE_FILE)
    authority = load_certificate(place / AUTHORITY_FILE)
    try:
        certificate.verify_directly_issued_by(authority)
    except (ValueError, TypeError, InvalidSignature):
        raise SecurityError(
            f"{place / CERTIFICATE_FILE} is not signed by {place / AUTHORITY_FILE}"
        ) from None
    key = load_key(place / KEY_FILE)
    if key.public_key() != certificate.public_key():
        raise SecurityError(f"{place / KEY_FILE} is not the key of {CERTIFICATE_FILE} beside it")
    now = datetime.now(UTC)
    for what, dated in ((CERTIFICATE_FILE, certificate), (AUTHORITY_FILE, authority)):
        if now < dated.not_valid_before_utc:
            raise SecurityError(
                f"{place / what} is valid from {dated.not_valid_before_utc:%Y-%m-%d %H:%M} UTC on; "
                "is this machine's clock right?"
            )
        if now >= dated.not_valid_after_utc:
            raise SecurityError(
                f"{place / what} has expired on {dated.not_valid_after_utc:%Y-%m-%d %H:%M} UTC: "
                f"`farhand keys renew SESSION.toml {identity.name}` makes a new certificate"
            )
    if credentials.revoked:
        raise SecurityError(
            f"{credentials.common_name} is revoked: {place / ALLOWED_FILE} does not have it; "
            f"`farhand keys renew SESSION.toml {identity.name}` makes its successor"
        )
    return credentials


def read_credentials(folder: Path, identity: Identity) -> Credentials:
    """Read an identity's folder, whatever state its certificate is in."""
    place = (folder / identity.name).resolve()
    if not place.is_dir():
        raise SecurityError(
            f"{place} does not exist: `farhand keys SESSION.toml` makes the keys of {identity.name}"
            ", or copy that folder here from where they were made"
        )
    certificate = load_certificate(place / CERTIFICATE_FILE)
    holder, generation = named(common_name_of(certificate))
    if holder != identity:
        raise SecurityError(
            f"{place / CERTIFICATE_FILE} is the certificate of {holder.name}, not of "
            f"{identity.name}"
        )
    return Credentials(
        identity,
        generation,
        place,
        read_allowed(place / ALLOWED_FILE),
        certificate.not_valid_after_utc,
        certificate.fingerprint(hashes.SHA256()).hex(),
        hosts_of(certificate),
    )


def common_name_of(certificate: x509.Certificate) -> str:
    """Return the name in a certificate, "" if it has none."""
    names = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    return str(names[0].value) if names else ""


def hosts_of(certificate: x509.Certificate) -> tuple[str, ...]:
    """Return the names and addresses that a certificate is good for."""
    try:
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return ()
    return tuple(str(name.value) for name in names)


def write_allowed(path: Path, common_names: Sequence[str]) -> None:
    """Write who is allowed."""
    write_private(path, json.dumps({"common_names": sorted(common_names)}, indent=2).encode())


def read_allowed(path: Path) -> tuple[str, ...]:
    """Read who is allowed."""
    try:
        content: Any = json.loads(_bytes(path))
    except ValueError as error:
        raise SecurityError(f"{path} is not JSON: {error}") from error
    names = content.get("common_names") if isinstance(content, dict) else None
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise SecurityError(f"{path} has no list of common_names")
    for name in names:
        named(name)
    return tuple(names)


def write_private(path: Path, content: bytes) -> None:
    """Write a file that only its owner reads; never half of it, and never open for a moment."""
    handle, temporary = tempfile.mkstemp(dir=path.parent)  # mode 0600
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        Path(temporary).replace(path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


def require_private(path: Path) -> None:
    """Raise SecurityError if others than its owner may do anything with a file or folder."""
    try:
        mode = stat.S_IMODE(path.stat().st_mode)
    except OSError as error:
        raise SecurityError(f"{path} cannot be read: {error.strerror}") from error
    if mode & 0o077:
        wanted = "700" if path.is_dir() else "600"
        raise SecurityError(
            f"{path} is open to others (mode {mode:03o}): `chmod {wanted} {path}`, and renew the "
            "key if anybody may have read it"
        )


def load_certificate(path: Path) -> x509.Certificate:
    """Read a certificate; SecurityError if there is none."""
    try:
        return x509.load_pem_x509_certificate(_bytes(path))
    except ValueError as error:
        raise SecurityError(f"{path} is no certificate: {error}") from error


def load_key(path: Path) -> ec.EllipticCurvePrivateKey:
    """Read a private key; SecurityError if there is none of the kind that farhand makes."""
    try:
        key = serialization.load_pem_private_key(_bytes(path), password=None)
    except (ValueError, TypeError) as error:
        raise SecurityError(f"{path} cannot be read: {error}") from error
    if not isinstance(key, ec.EllipticCurvePrivateKey):
        raise SecurityError(f"{path} is no key on an elliptic curve")
    return key


def _bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise SecurityError(f"{path} cannot be read: {error.strerror}") from error
