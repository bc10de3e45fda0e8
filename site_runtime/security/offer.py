"""Keys for sealed packets, agreed between two runs: signed offers, and what two of them make.

Whoever passes an offer on, the relay too, can hold it back but neither change it nor put its own
key in: an offer counts by the certificate in it, not by the connection on which it came.
"""

import struct
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Final

from cryptography import x509
from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey, X25519PublicKey
from cryptography.hazmat.primitives.kdf.hkdf import HKDF

from channel.sealed_link import KEY_BYTES, KEY_ID_BYTES, PacketKeys
from site_runtime.keys import SiteId
from site_runtime.security.credentials import (
    AUTHORITY_FILE,
    CERTIFICATE_FILE,
    KEY_FILE,
    Credentials,
    common_name_of,
    load_certificate,
    load_key,
)
from site_runtime.security.identity import SecurityError

MOST_OFFER_BYTES: Final = 4096

_VERSION = 1
_HEAD = struct.Struct(">BQQ32sH")  # version, session digest, epoch, key, certificate's length
_SIGNED_FOR = b"farhand: offer of a key for sealed packets\0"
_KEYS_FOR = b"farhand: keys of sealed packets, "
_UNREADABLE = (ValueError, TypeError, x509.InvalidVersion, UnsupportedAlgorithm)
_SIGNATURE = ec.ECDSA(hashes.SHA256())


class OfferError(SecurityError):
    """An offer that must not be taken; the message says why, as `is …`."""


@dataclass(frozen=True, slots=True)
class Offer:
    """A peer's, checked: the key of one of its runs, until its certificate expires."""

    public: bytes
    expires: datetime
    signed: bytes


class OwnOffer:
    """What one run of a site offers: its `payload`, and a private key that dies with the run."""

    def __init__(
        self, site: SiteId, credentials: Credentials, session_digest: int, epoch: int
    ) -> None:
        self._site = site
        self._private = X25519PrivateKey.generate()
        certificate = load_certificate(credentials.folder / CERTIFICATE_FILE)
        shown = certificate.public_bytes(serialization.Encoding.DER)
        public = self._private.public_key().public_bytes_raw()
        self._signed = _HEAD.pack(_VERSION, session_digest, epoch, public, len(shown)) + shown
        key = load_key(credentials.folder / KEY_FILE)
        self.payload = self._signed + key.sign(_SIGNED_FOR + self._signed, _SIGNATURE)

    def keys_with(self, offer: Offer) -> PacketKeys:
        """Return the keys that only the two who made these offers can know.

        Both offers go into them, certificates and all: who was shown another has other keys.
        """
        try:
            secret = self._private.exchange(X25519PublicKey.from_public_bytes(offer.public))
        except ValueError as error:
            raise OfferError("is of a key that is none") from error
        ways = (SiteId.LOCAL, SiteId.REMOTE)
        signed = {self._site: self._signed, self._site.peer: offer.signed}
        context = b"".join(_hash(signed[site]) for site in ways)
        sealing, opening = (
            HKDF(
                algorithm=hashes.SHA256(),
                length=KEY_ID_BYTES + KEY_BYTES,
                salt=None,
                info=_KEYS_FOR + f"from {site.label}: ".encode() + context,
            ).derive(secret)
            for site in (self._site, self._site.peer)
        )
        return PacketKeys(sealing, opening)


class OfferReader:
    """Checks offers for one session against what this party's own folder says."""

    def __init__(self, credentials: Credentials, session_digest: int) -> None:
        self._authority = load_certificate(credentials.folder / AUTHORITY_FILE)
        self._digest = session_digest

    def read(self, payload: bytes, common_name: str) -> Offer:
        """Return the offer if it is of `common_name`, now, for this session; else OfferError."""
        if not _HEAD.size < len(payload) <= MOST_OFFER_BYTES:
            raise OfferError(f"is no offer: it has {len(payload)} bytes")
        version, digest, _, public, length = _HEAD.unpack_from(payload)
        end = _HEAD.size + length
        if version != _VERSION:
            raise OfferError(f"is of version {version}, not {_VERSION}")
        try:
            certificate = x509.load_der_x509_certificate(payload[_HEAD.size : end])
            name = common_name_of(certificate)
        except _UNREADABLE as error:
            raise OfferError("shows no certificate") from error
        try:
            certificate.verify_directly_issued_by(self._authority)
        except (*_UNREADABLE, InvalidSignature):
            raise OfferError("shows a certificate of another authority") from None
        if name != common_name:
            raise OfferError(f"shows the certificate of {name}, not of {common_name}")
        now, expires = datetime.now(UTC), certificate.not_valid_after_utc
        if not certificate.not_valid_before_utc <= now < expires:
            raise OfferError("shows a certificate that is not valid now")
        key = certificate.public_key()
        if not isinstance(key, ec.EllipticCurvePublicKey):
            raise OfferError("shows a certificate whose key is on no elliptic curve")
        try:
            key.verify(payload[end:], _SIGNED_FOR + payload[:end], _SIGNATURE)
        except InvalidSignature:
            raise OfferError("is not signed by its certificate's key") from None
        if digest != self._digest:
            raise OfferError("is for another session file")
        return Offer(public, expires, payload[:end])


def _hash(data: bytes) -> bytes:
    digest = hashes.Hash(hashes.SHA256())
    digest.update(data)
    return digest.finalize()
