"""What operators and the remote site tell each other of the lease: JSON of a fixed form."""

from dataclasses import dataclass, field
from typing import Annotated, ClassVar, Final, Generic, TypeVar

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError

from site_runtime.lease import Verb, Wish

MOST_WISH_BYTES: Final = 512
MOST_STATUS_BYTES: Final = 16 * 1024

Person = Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_-]{0,31}$")]
Epoch = Annotated[str, Field(pattern=r"^[0-9]{1,19}$")]
Words = Annotated[str, Field(max_length=240)]
_STRICT = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False)
_T = TypeVar("_T")


@dataclass(frozen=True, slots=True)
class Answer:
    """What became of an operator's newest wish other than a claim."""

    __pydantic_config__: ClassVar[ConfigDict] = _STRICT
    epoch: Epoch
    granted: bool
    text: Words


@dataclass(frozen=True, slots=True)
class RemoteStatus:
    """How a remote site is, and who holds it; `leased` says whether that is a matter of names.

    Epochs are texts: they have more digits than a double. `round_trip_s` is None without a peer.
    """

    __pydantic_config__: ClassVar[ConfigDict] = _STRICT
    session: Words
    epoch: Epoch
    state: Words
    dimension: Annotated[int, Field(ge=1, le=3)]
    leased: bool
    holder: Person | None = None
    held_s: Annotated[float, Field(ge=0)] | None = None
    round_trip_s: Annotated[float, Field(ge=0)] | None = None
    refused: dict[Person, Words] = field(default_factory=dict)
    answers: dict[Person, Answer] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class _Wish:
    __pydantic_config__: ClassVar[ConfigDict] = _STRICT
    verb: Verb
    epoch: Epoch
    to: Person | None = None


class _Form(Generic[_T]):
    """Bytes to and from one kind of message; anything else is None."""

    def __init__(self, kind: type[_T], most_bytes: int) -> None:
        self._adapter = TypeAdapter(kind)
        self._most_bytes = most_bytes

    def read(self, payload: bytes) -> _T | None:
        if len(payload) > self._most_bytes:
            return None
        try:
            return self._adapter.validate_json(payload)
        except ValidationError:
            return None

    def write(self, message: _T) -> bytes:
        return self._adapter.dump_json(message)


_WISHES = _Form(_Wish, MOST_WISH_BYTES)
_STATUSES = _Form(RemoteStatus, MOST_STATUS_BYTES)


def encode_wish(wish: Wish) -> bytes:
    """Return a wish as it travels."""
    return _WISHES.write(_Wish(wish.verb, str(wish.epoch), wish.to))


def decode_wish(payload: bytes) -> Wish | None:
    """Return the wish in a payload from the network, None if it holds none."""
    read = _WISHES.read(payload)
    return None if read is None else Wish(read.verb, int(read.epoch), read.to)


def encode_status(status: RemoteStatus) -> bytes:
    """Return a status as it travels."""
    return _STATUSES.write(status)


def decode_status(payload: bytes) -> RemoteStatus | None:
    """Return the status in a payload from the network, None if it holds none."""
    return _STATUSES.read(payload)
