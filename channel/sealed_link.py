"""Datagrams sealed end to end: who carries them can neither read, change, repeat nor make them."""

import struct
from collections import Counter
from collections.abc import Callable
from enum import StrEnum
from typing import Final

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305

from channel.link import Link

VERSION: Final = 1
KEY_BYTES: Final = 32
KEY_ID_BYTES: Final = 4
_HEADER = struct.Struct(">B4sQ")  # version, key id, sequence; what is sealed follows
_PADDING = bytes(4)  # of the sequence, to a nonce of 12 bytes
_SEQUENCE = slice(1 + KEY_ID_BYTES, _HEADER.size)
_TAG_BYTES = 16

OVERHEAD_BYTES: Final = _HEADER.size + _TAG_BYTES
"""What a sealed datagram is longer than a plain one."""


class Refusal(StrEnum):
    """Why a datagram was not opened."""

    MALFORMED = "malformed"
    KEY = "under no key in use"
    TAG = "forged"
    REPLAY = "repeated or overtaken"


class PacketKeys:
    """The keys of one agreement between two runs, one each way.

    It remembers what was opened: keep one object an agreement, also while another is in use.
    """

    __slots__ = ("greatest", "opener", "opening_id", "sealer", "sealing_id")

    def __init__(self, sealing: bytes, opening: bytes) -> None:
        """Each is a key id and a key; ValueError if it is not (36,) bytes."""
        for given in (sealing, opening):
            if len(given) != KEY_ID_BYTES + KEY_BYTES:
                raise ValueError(f"a key and its id have {len(given)} bytes, not 36")
        self.sealing_id, self.sealer = sealing[:KEY_ID_BYTES], _cipher(sealing)
        self.opening_id, self.opener = opening[:KEY_ID_BYTES], _cipher(opening)
        self.greatest = 0


class SealedLink:
    """Seals what a link carries; without keys it drops everything.

    `present` tells whether the far end is there: what the link itself sees may be anybody.
    Datagrams that are not newer than one that was opened are refused. The link's end counts for
    both, `use` may be called from any thread.
    """

    def __init__(self, link: Link, present: Callable[[], bool]) -> None:
        self._link = link
        self._present = present
        self._keys: PacketKeys | None = None
        self._sequence = 0  # one for all keys: none ever sees a nonce twice
        self.opened = 0
        self.refused: Counter[Refusal] = Counter(dict.fromkeys(Refusal, 0))

    @property
    def keys(self) -> PacketKeys | None:
        """The keys in use."""
        return self._keys

    def use(self, keys: PacketKeys | None) -> None:
        """Seal and open with other keys from now on, or with none."""
        self._keys = keys

    def send(self, data: bytes) -> bool:
        """Seal and hand over one datagram; False if it was dropped."""
        keys = self._keys
        if keys is None:
            return False
        self._sequence += 1
        header = _HEADER.pack(VERSION, keys.sealing_id, self._sequence)
        sealed = keys.sealer.encrypt(_PADDING + header[_SEQUENCE], data, header)
        return self._link.send(header + sealed)

    def receive(self) -> list[bytes]:
        """Return what arrived and could be opened since the last call, oldest first."""
        arrived = self._link.receive()
        if not arrived:
            return arrived
        keys = self._keys  # once: another thread may change it
        opened: list[bytes] = []
        for data in arrived:
            plain = _open(keys, data)
            if isinstance(plain, Refusal):
                self.refused[plain] += 1
            else:
                opened.append(plain)
        self.opened += len(opened)
        return opened

    def peer_present(self) -> bool:
        """Whether the far end is there."""
        return self._present()

    def close(self) -> None:
        """Leave."""
        self._keys = None
        self._link.close()


def _open(keys: PacketKeys | None, data: bytes) -> bytes | Refusal:
    if len(data) < OVERHEAD_BYTES or data[0] != VERSION:
        return Refusal.MALFORMED
    header = data[: _HEADER.size]
    _, key_id, sequence = _HEADER.unpack(header)
    if keys is None or key_id != keys.opening_id:
        return Refusal.KEY
    if sequence <= keys.greatest:
        return Refusal.REPLAY
    try:
        plain = keys.opener.decrypt(_PADDING + header[_SEQUENCE], data[_HEADER.size :], header)
    except InvalidTag:
        return Refusal.TAG
    keys.greatest = sequence
    return plain


def _cipher(key: bytes) -> ChaCha20Poly1305:
    return ChaCha20Poly1305(key[KEY_ID_BYTES:])
