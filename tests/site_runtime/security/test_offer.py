"""Offers of keys: whose are taken, and that only the two who made them come to the same keys."""

import shutil
from datetime import timedelta
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from channel.memory_link import memory_links
from channel.sealed_link import PacketKeys, SealedLink
from site_runtime.keys import SiteId
from site_runtime.security.authority import Authority, create_authority
from site_runtime.security.credentials import (
    KEY_FILE,
    Credentials,
    load_credentials,
    load_key,
    read_credentials,
)
from site_runtime.security.identity import SITES, Identity
from site_runtime.security.offer import _SIGNATURE, OfferError, OfferReader, OwnOffer

LOCAL, REMOTE = SiteId.LOCAL, SiteId.REMOTE
DIGEST = 7
PUBLIC = slice(17, 49)  # where the key of an offer stands


@pytest.fixture(scope="module")
def authority(tmp_path_factory: pytest.TempPathFactory) -> Authority:
    authority = create_authority(tmp_path_factory.mktemp("keys"), "trial")
    for identity in (*SITES.values(), Identity("dashboard"), Identity("operator.bob")):
        authority.issue(identity, ["127.0.0.1"])
    return authority


def shown(authority: Authority, name: str) -> Credentials:
    return read_credentials(authority.folder, Identity(name))


def offer(authority: Authority, name: str, digest: int = DIGEST, epoch: int = 1) -> OwnOffer:
    site = REMOTE if name == "remote" else LOCAL
    return OwnOffer(site, shown(authority, name), digest, epoch)


def reader(authority: Authority) -> OfferReader:
    return OfferReader(load_credentials(authority.folder, SITES[REMOTE]), DIGEST)


def pass_both_ways(first: PacketKeys, second: PacketKeys) -> bool:
    links = memory_links(4)
    one, other = (SealedLink(link, link.peer_present) for link in links)
    one.use(first)
    other.use(second)
    one.send(b"there")
    other.send(b"back")
    return (other.receive(), one.receive()) == ([b"there"], [b"back"])


def test_two_that_take_each_other_s_offers_have_the_same_keys(authority: Authority) -> None:
    local, remote = offer(authority, "local"), offer(authority, "remote")
    read = reader(authority).read
    there = local.keys_with(read(remote.payload, "remote-1"))
    back = remote.keys_with(read(local.payload, "local-1"))
    assert pass_both_ways(there, back)
    assert there.sealing_id != there.opening_id


@pytest.mark.parametrize("which", ["run", "epoch", "digest"])
def test_every_run_has_keys_of_its_own(authority: Authority, which: str) -> None:
    remote = offer(authority, "remote")
    read = reader(authority).read
    before = remote.keys_with(read(offer(authority, "local").payload, "local-1"))
    if which == "run":
        after = offer(authority, "local").keys_with(read(remote.payload, "remote-1"))
        assert not pass_both_ways(after, before)
        return
    # the very same secret in another context
    changed = offer(authority, "remote", *((8, 1) if which == "digest" else (DIGEST, 2)))
    changed._private = remote._private
    local = offer(authority, "local")
    heard = read(local.payload, "local-1")
    assert local.keys_with(read(remote.payload, "remote-1")).opening_id == (
        remote.keys_with(heard).sealing_id
    )
    assert changed.keys_with(heard).sealing_id != remote.keys_with(heard).sealing_id


@pytest.mark.parametrize("thief", ["dashboard", "operator.bob", "remote"])
def test_a_certificate_of_somebody_else_offers_nothing(authority: Authority, thief: str) -> None:
    with pytest.raises(OfferError, match=f"{thief}-1, not of local-1"):
        reader(authority).read(offer(authority, thief).payload, "local-1")


def test_a_revoked_certificate_offers_nothing(tmp_path: Path) -> None:
    authority = create_authority(tmp_path / "keys", "x")
    for site in SITES.values():
        authority.issue(site, ["127.0.0.1"])
    shutil.copytree(authority.folder / "local", tmp_path / "stolen" / "local")
    authority.revoke(SITES[LOCAL])
    authority.issue(SITES[LOCAL], ["127.0.0.1"])
    stolen = read_credentials(tmp_path / "stolen", SITES[LOCAL])
    (name,) = [name for name in authority.allowed if name.startswith("local")]
    with pytest.raises(OfferError, match="local-1, not of local-2"):
        reader(authority).read(OwnOffer(LOCAL, stolen, DIGEST, 1).payload, name)
    reader(authority).read(offer(authority, "local").payload, name)


def test_another_authority_offers_nothing(authority: Authority, tmp_path: Path) -> None:
    other = create_authority(tmp_path / "keys", "trial")
    other.issue(SITES[LOCAL], ["127.0.0.1"])
    with pytest.raises(OfferError, match="another authority"):
        reader(authority).read(offer(other, "local").payload, "local-1")


def test_an_expired_certificate_offers_nothing(tmp_path: Path) -> None:
    authority = create_authority(tmp_path / "keys", "x")
    authority.issue(SITES[REMOTE], ["127.0.0.1"])
    authority.issue(SITES[LOCAL], ["127.0.0.1"], life=timedelta(seconds=-1))
    with pytest.raises(OfferError, match="not valid now"):
        reader(authority).read(offer(authority, "local").payload, "local-1")


def test_another_session_s_offer_is_none(authority: Authority) -> None:
    with pytest.raises(OfferError, match="another session file"):
        reader(authority).read(offer(authority, "local", digest=8).payload, "local-1")


def test_a_key_that_was_put_in_on_the_way_is_seen(authority: Authority) -> None:
    payload = bytearray(offer(authority, "local").payload)
    reader(authority).read(bytes(payload), "local-1")
    payload[PUBLIC] = X25519PrivateKey.generate().public_key().public_bytes_raw()
    with pytest.raises(OfferError, match="not signed"):
        reader(authority).read(bytes(payload), "local-1")


def test_a_signature_over_something_else_is_none(authority: Authority) -> None:
    """What the key signs for TLS, or of an offer without its purpose, is no offer."""
    own = offer(authority, "local")
    key = load_key(authority.folder / "local" / KEY_FILE)
    with pytest.raises(OfferError, match="not signed"):
        reader(authority).read(own._signed + key.sign(own._signed, _SIGNATURE), "local-1")


def test_a_key_that_makes_no_secret_is_refused(authority: Authority) -> None:
    """One of low order: the secret would be zero, whatever the other key."""
    local, remote = offer(authority, "local"), offer(authority, "remote")
    read = reader(authority).read(local.payload, "local-1")
    for low in (bytes(32), b"\1" + bytes(31)):
        bad = type(read)(low, read.expires, read.signed)
        with pytest.raises(OfferError, match="none"):
            remote.keys_with(bad)


@pytest.mark.filterwarnings("ignore:Parsed a serial number")  # of a certificate that was changed
def test_whatever_byte_is_changed_it_is_refused(authority: Authority) -> None:
    payload, read = offer(authority, "local").payload, reader(authority).read
    for at in range(len(payload)):
        for bits in (0x01, 0x80, 0xFF):
            changed = bytearray(payload)
            changed[at] ^= bits
            with pytest.raises(OfferError):
                read(bytes(changed), "local-1")
    read(payload, "local-1")


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.binary(max_size=5000))
def test_garbage_is_refused(authority: Authority, data: bytes) -> None:
    for payload in (data, b"\1" + data):
        with pytest.raises(OfferError):
            reader(authority).read(payload, "local-1")
