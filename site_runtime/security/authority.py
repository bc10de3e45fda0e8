"""The certificate authority: makes, renews and revokes the identities of a keys folder.

EC P-256: what every TLS library and hardware token knows. Zenoh reads no revocation list; revoked
is whom no `allowed.json` names, and a successor has the next generation in its name.
"""

import ipaddress
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from site_runtime.security.credentials import (
    ALLOWED_FILE,
    AUTHORITY_FILE,
    CERTIFICATE_FILE,
    KEY_FILE,
    require_private,
    write_allowed,
    write_private,
)
from site_runtime.security.identity import AUTHORITY, Identity, Role, SecurityError

AUTHORITY_LIFE = timedelta(days=3652)
"""Its end touches every machine at once: ten years, about a machine's life."""
LIFE = timedelta(days=365)
"""One yearly visit renews it, and a certificate that everybody forgot ends by itself."""
CLOCK_SKEW = timedelta(hours=1)
"""How far the clock of a machine that gets a certificate may be behind."""

_ISSUED_FILE = "issued.json"


@dataclass(frozen=True, slots=True)
class _Issued:
    generation: int
    revoked: bool
    hosts: tuple[str, ...]


@dataclass(slots=True)
class Authority:
    """An authority whose private key is at hand; made by `create_authority`, `open_authority`."""

    folder: Path
    _certificate: x509.Certificate
    _key: ec.EllipticCurvePrivateKey
    _issued: dict[Identity, _Issued] = field(default_factory=dict)

    @property
    def identities(self) -> tuple[Identity, ...]:
        """Every identity that ever was."""
        return tuple(self._issued)

    @property
    def allowed(self) -> tuple[str, ...]:
        """Common names that are not revoked."""
        return tuple(
            identity.common_name(issued.generation)
            for identity, issued in self._issued.items()
            if not issued.revoked
        )

    def issue(self, identity: Identity, hosts: Iterable[str], life: timedelta = LIFE) -> str:
        """Make the first certificate of an identity, or a new one; return its common name.

        A new one has the name of the old, which stays valid until it expires; after a revocation
        the next name. `hosts` are added to those that it was made for before.
        """
        before = self._issued.get(identity, _Issued(1, False, ()))
        issued = _Issued(
            before.generation + before.revoked,
            False,
            tuple(dict.fromkeys((*before.hosts, *hosts))),
        )
        common_name = identity.common_name(issued.generation)
        key = ec.generate_private_key(ec.SECP256R1())
        certificate = self._sign(key, common_name, identity.role, issued.hosts, life)
        place = self.folder / identity.name
        place.mkdir(mode=0o700, exist_ok=True)
        require_private(place)
        write_private(place / KEY_FILE, _key_pem(key))
        write_private(place / CERTIFICATE_FILE, _pem(certificate))
        write_private(place / AUTHORITY_FILE, _pem(self._certificate))
        self._keep(identity, issued)
        return common_name

    def revoke(self, identity: Identity) -> str:
        """Allow an identity's generation no more; return the common name that is revoked."""
        if identity not in self._issued:
            raise SecurityError(f"{identity.name} has no certificate that could be revoked")
        before = self._issued[identity]
        self._keep(identity, _Issued(before.generation, True, before.hosts))
        return identity.common_name(before.generation)

    def _keep(self, identity: Identity, issued: _Issued) -> None:
        self._issued[identity] = issued
        content = {
            one.name: {
                "generation": state.generation,
                "revoked": state.revoked,
                "hosts": list(state.hosts),
            }
            for one, state in self._issued.items()
        }
        path = self.folder / AUTHORITY / _ISSUED_FILE
        write_private(path, json.dumps(content, indent=2).encode())
        for one in self._issued:
            if (place := self.folder / one.name).is_dir():
                write_allowed(place / ALLOWED_FILE, self.allowed)

    def _sign(
        self,
        key: ec.EllipticCurvePrivateKey,
        common_name: str,
        role: Role,
        hosts: Sequence[str],
        life: timedelta,
    ) -> x509.Certificate:
        now = datetime.now(UTC)
        end = min(now + life, self._certificate.not_valid_after_utc)
        # an observer only ever dials: with its certificate nobody can pass for a site that listens
        usage = [ExtendedKeyUsageOID.CLIENT_AUTH]
        if role is not Role.OBSERVER:
            usage.append(ExtendedKeyUsageOID.SERVER_AUTH)
        public = self._key.public_key()
        builder = (
            _builder(common_name, key, now - CLOCK_SKEW, end)
            .issuer_name(self._certificate.subject)
            .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .add_extension(_key_usage(signs_certificates=False), critical=True)
            .add_extension(x509.ExtendedKeyUsage(usage), critical=False)
            .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(public), False)
        )
        if hosts and role is not Role.OBSERVER:
            names = x509.SubjectAlternativeName([_general_name(host) for host in hosts])
            builder = builder.add_extension(names, critical=False)
        return builder.sign(self._key, hashes.SHA256())


def create_authority(folder: Path, name: str) -> Authority:
    """Make a keys folder and its authority; SecurityError if there is one."""
    place = folder / AUTHORITY
    if (place / KEY_FILE).exists():
        raise SecurityError(f"{place} holds an authority already")
    for made in (folder, place):
        made.mkdir(mode=0o700, parents=True, exist_ok=True)
        require_private(made)
    key = ec.generate_private_key(ec.SECP256R1())
    now = datetime.now(UTC)
    certificate = (
        _builder(f"farhand authority of {name}"[:64], key, now - CLOCK_SKEW, now + AUTHORITY_LIFE)
        .issuer_name(_name(f"farhand authority of {name}"[:64]))
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(_key_usage(signs_certificates=True), critical=True)
        .sign(key, hashes.SHA256())
    )
    write_private(place / KEY_FILE, _key_pem(key))
    write_private(place / AUTHORITY_FILE, _pem(certificate))
    return Authority(folder, certificate, key)


def open_authority(folder: Path) -> Authority:
    """Open the authority of a keys folder; SecurityError if its key is not here."""
    place = folder / AUTHORITY
    try:
        certificate = x509.load_pem_x509_certificate((place / AUTHORITY_FILE).read_bytes())
        require_private(place / KEY_FILE)
        key = serialization.load_pem_private_key((place / KEY_FILE).read_bytes(), password=None)
        issued: Any = {}
        if (place / _ISSUED_FILE).exists():
            issued = json.loads((place / _ISSUED_FILE).read_text(encoding="utf-8"))
        known = {
            Identity(name): _Issued(state["generation"], state["revoked"], tuple(state["hosts"]))
            for name, state in issued.items()
        }
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise SecurityError(
            f"{place} is no authority that can be used ({error}): only the machine that keeps its "
            "key makes, renews and revokes certificates"
        ) from error
    if not isinstance(key, ec.EllipticCurvePrivateKey):
        raise SecurityError(f"{place / KEY_FILE} is no key on an elliptic curve")
    return Authority(folder, certificate, key, known)


def _builder(
    common_name: str, key: ec.EllipticCurvePrivateKey, start: datetime, end: datetime
) -> x509.CertificateBuilder:
    return (
        x509.CertificateBuilder()
        .subject_name(_name(common_name))
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(start)
        .not_valid_after(end)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
    )


def _key_usage(*, signs_certificates: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs_certificates,
        key_cert_sign=signs_certificates,
        crl_sign=signs_certificates,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        encipher_only=False,
        decipher_only=False,
    )


def _general_name(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def _name(common_name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common_name)])


def _pem(certificate: x509.Certificate) -> bytes:
    return certificate.public_bytes(serialization.Encoding.PEM)


def _key_pem(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(
        serialization.Encoding.PEM,
        serialization.PrivateFormat.PKCS8,
        serialization.NoEncryption(),
    )
