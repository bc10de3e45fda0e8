"""Mutations of valid packets, each a draw of one seeded generator."""

import struct
from collections.abc import Callable, Sequence
from random import Random

from tests.fuzz.layout import (
    BY_NAME,
    DIMENSION_OFFSET,
    FIELDS,
    SIZES,
    VECTORS_OFFSET,
    Field,
    overwritten,
    resealed,
)

Mutation = Callable[[Random, bytes, Sequence[bytes]], bytes]

_FLOATS = tuple(
    struct.pack("<d", value)
    for value in (
        float("nan"),
        float("inf"),
        -float("inf"),
        1e308,
        -1e308,
        1e154,
        5e-324,
        -0.0,
        1.0,
    )
)
_DECIDING = tuple(
    BY_NAME[name] for name in ("site", "session", "epoch", "sequence", "stamp_ns", "echo_epoch")
)


def _flipped(rng: Random, data: bytes, _: Sequence[bytes]) -> bytes:
    mutated = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 2, 3, 8, 32))):
        mutated[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    return bytes(mutated)


def _scribbled(rng: Random, data: bytes, _: Sequence[bytes]) -> bytes:
    return overwritten(data, rng.randrange(len(data)), rng.randbytes(rng.randint(1, 16)))


def _cut(rng: Random, data: bytes, _: Sequence[bytes]) -> bytes:
    return data[: rng.randrange(len(data))]


def _extended(rng: Random, data: bytes, _: Sequence[bytes]) -> bytes:
    extra = rng.randbytes(rng.randint(1, 64))
    return rng.choice((data + extra, extra + data, data + data))


def _shifted(rng: Random, data: bytes, _: Sequence[bytes]) -> bytes:
    """Leave a piece out, or have it twice."""
    start, end = sorted((rng.randrange(len(data)), rng.randrange(len(data))))
    return rng.choice((data[:start] + data[end:], data[:end] + data[start:]))


def _noise(rng: Random, data: bytes, _: Sequence[bytes]) -> bytes:
    keep = rng.choice((0, DIMENSION_OFFSET - 3, DIMENSION_OFFSET + 1))
    return data[:keep] + rng.randbytes(
        rng.choice((0, 1, 16, 400, *(s - keep for s in SIZES.values())))
    )


def _replayed(rng: Random, _: bytes, pool: Sequence[bytes]) -> bytes:
    return rng.choice(pool)


def _spliced(rng: Random, data: bytes, pool: Sequence[bytes]) -> bytes:
    other = rng.choice(pool)
    place = rng.randrange(len(data))
    joint = data[:place] + other[place:]
    return resealed(joint) if rng.random() < 0.5 and len(joint) > VECTORS_OFFSET else joint


def _value(rng: Random, field: Field, present: int) -> int:
    near = present + rng.choice((-1000, -1, 1, 2, 1_000_000, 1_000_000_000))
    value = rng.choice((field.least, field.most, 0, 1, near, rng.randint(field.least, field.most)))
    return min(max(value, field.least), field.most)


def _field_forged(rng: Random, data: bytes, _: Sequence[bytes]) -> bytes:
    field = rng.choice(FIELDS)
    return resealed(field.written(data, _value(rng, field, field.read(data))))


def _several_fields_forged(rng: Random, data: bytes, _: Sequence[bytes]) -> bytes:
    for field in rng.sample(_DECIDING, rng.randint(1, 3)):
        data = field.written(data, _value(rng, field, field.read(data)))
    return resealed(data)


def _vector_forged(rng: Random, data: bytes, _: Sequence[bytes]) -> bytes:
    place = VECTORS_OFFSET + 8 * rng.randrange((len(data) - VECTORS_OFFSET) // 8)
    return resealed(overwritten(data, place, rng.choice(_FLOATS)))


def _damage_sealed(rng: Random, data: bytes, pool: Sequence[bytes]) -> bytes:
    return resealed(rng.choice((_flipped, _scribbled))(rng, data, pool))


MUTATIONS: dict[str, Mutation] = {
    "bits flipped": _flipped,
    "scribbled over": _scribbled,
    "cut": _cut,
    "extended": _extended,
    "shifted": _shifted,
    "noise": _noise,
    "replayed": _replayed,
    "spliced": _spliced,
    "one field forged": _field_forged,
    "several fields forged": _several_fields_forged,
    "a vector forged": _vector_forged,
    "damaged and sealed": _damage_sealed,
}
_ALL = tuple(MUTATIONS.values())


def mutated(rng: Random, data: bytes, pool: Sequence[bytes]) -> bytes:
    """Return a mutation of a valid packet; `pool` has others, to replay and to splice with."""
    return rng.choice(_ALL)(rng, data, pool)
