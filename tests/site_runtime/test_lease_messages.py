"""What of the network is taken for a word on the lease, and what is not."""

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from site_runtime.lease import Verb, Wish
from site_runtime.lease_messages import (
    MOST_WISH_BYTES,
    Answer,
    RemoteStatus,
    decode_status,
    decode_wish,
    encode_status,
    encode_wish,
)

STATUS = RemoteStatus(
    session="trial",
    epoch=str(2**62 + 1),
    state="ENGAGED",
    dimension=2,
    leased=True,
    holder="alice",
    held_s=3.5,
    round_trip_s=None,
    refused={"bob": "alice holds it"},
    answers={"bob": Answer("7", False, "no")},
)


@given(
    st.sampled_from(list(Verb)),
    st.integers(0, 10**19 - 1),
    st.one_of(st.none(), st.from_regex(r"[a-z0-9][a-z0-9_-]{0,31}", fullmatch=True)),
)
def test_a_wish_arrives_as_it_was(verb: Verb, epoch: int, to: str | None) -> None:
    wish = Wish(verb, epoch, to)
    payload = encode_wish(wish)
    assert len(payload) < MOST_WISH_BYTES
    assert decode_wish(payload) == wish


def test_a_status_arrives_as_it_was() -> None:
    assert decode_status(encode_status(STATUS)) == STATUS


@pytest.mark.parametrize(
    "change",
    [
        {"verb": "steal"},
        {"verb": None},
        {"epoch": 5},
        {"epoch": "-5"},
        {"epoch": "1" * 20},
        {"epoch": "0x5"},
        {"to": ["bob"]},
        {"to": "../remote"},
        {"to": "bob/state"},
        {"to": "b" * 33},
        {"more": 1},
    ],
    ids=str,
)
def test_what_is_not_a_wish(change: dict[str, object]) -> None:
    good = {"verb": "give", "epoch": "5", "to": "bob"}
    assert decode_wish(json.dumps(good).encode()) == Wish(Verb.GIVE, 5, "bob")
    assert decode_wish(json.dumps(good | change).encode()) is None


@pytest.mark.parametrize(
    "change",
    [
        {"dimension": 4},
        {"dimension": "2"},
        {"holder": "*"},
        {"held_s": -1.0},
        {"round_trip_s": "0.1"},
        {"answers": {"bob": {"epoch": "7", "granted": 1, "text": "no"}}},
        {"refused": {"bob": "x" * 241}},
        {"more": 1},
    ],
    ids=str,
)
def test_what_is_not_a_status(change: dict[str, object]) -> None:
    good = json.loads(encode_status(STATUS))
    assert decode_status(json.dumps(good | change).encode()) is None


@given(st.binary(max_size=600))
def test_any_bytes_are_read_or_left(payload: bytes) -> None:
    assert decode_wish(payload) is None
    assert decode_status(payload) is None


def test_what_is_too_long_is_not_even_looked_at() -> None:
    payload = encode_wish(Wish(Verb.CLAIM, 5))
    padded = payload + b" " * (MOST_WISH_BYTES - len(payload))
    assert decode_wish(padded) is not None
    assert decode_wish(padded + b" ") is None
