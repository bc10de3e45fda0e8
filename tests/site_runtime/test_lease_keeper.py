"""Both sides of the lease by hand: a manual clock, a site in words, no network."""

from collections import deque
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace

from site_runtime.clock import ManualClock
from site_runtime.daemon_log import DaemonLog
from site_runtime.lease import LeaseRules, Verb, Wish
from site_runtime.lease_claimant import LeaseClaimant
from site_runtime.lease_keeper import LeaseKeeper
from site_runtime.lease_messages import RemoteStatus, decode_status, encode_status, encode_wish
from site_runtime.operator_requests import UNLEASED, OperatorRequests
from site_runtime.session import load_session
from site_runtime.supervisor import State

S = 1_000_000_000
DEMO = Path(__file__).parents[2] / "experiments" / "demo.toml"
SESSION = load_session(DEMO)


@dataclass
class Words:
    """An ear and a mouth in one."""

    said: list[bytes] = field(default_factory=list)

    def receive(self) -> list[tuple[str, bytes]]:
        said, self.said = self.said, []
        return [("", payload) for payload in said]

    def __call__(self, payload: bytes) -> None:
        self.said.append(payload)

    def statuses(self) -> list[RemoteStatus]:
        return [status for _, data in self.receive() if (status := decode_status(data))]


@dataclass
class Place:
    """What the keeper sees of a site, and where it turned the link."""

    names: tuple[str, ...] = ("alice", "bob")
    clock: ManualClock = field(default_factory=ManualClock)
    turned: list[str | None] = field(default_factory=list)
    out: Words = field(default_factory=Words)

    def __post_init__(self) -> None:
        self.site = SimpleNamespace(
            requests=OperatorRequests(),
            notices=deque[str](),
            state=State.READY,
            ticks=0,
            round_trip_s=float("nan"),
            channel=SimpleNamespace(heard_ns=None),
        )
        self.ears = {name: Words() for name in self.names}
        self.keeper = LeaseKeeper(
            SESSION,
            self.site,
            5,
            self.clock,
            self,
            self.ears,
            LeaseRules(5 * S),
            self.out,
            DaemonLog("remote"),
        )
        assert self.turned == [None] * bool(self.names), "heard somebody at first"
        self.turned.clear()

    def listen_to(self, peer_key: str | None) -> None:
        if peer_key is not None:
            assert self.site.requests.take() & UNLEASED, "obeyed before it was to be"
        self.turned.append(peer_key)

    def say(self, name: str, verb: Verb, epoch: int, to: str | None = None) -> None:
        self.ears[name](encode_wish(Wish(verb, epoch, to)))

    def look(self, ticks: int = 10, wait_s: float = 0.1) -> None:
        self.clock.sleep_until_ns(self.clock.now_ns() + round(wait_s * S))
        self.site.ticks += ticks
        self.keeper.look()


def test_nobody_is_obeyed_until_he_claims() -> None:
    place = Place()
    assert place.site.requests.take() == UNLEASED
    place.look()
    assert place.turned == []
    place.say("alice", Verb.CLAIM, 1)
    place.look()
    assert place.turned == [f"farhand/{SESSION.name}/local/alice/state"]
    assert place.site.requests.take() == 0
    assert list(place.site.notices) == ["lease: alice claims it", "lease: alice holds it"]


def test_between_two_the_link_is_deaf_until_the_site_is_at_rest_and_silent() -> None:
    place = Place()
    place.say("alice", Verb.CLAIM, 1)
    place.look()
    place.site.state = State.ENGAGED
    place.site.channel.heard_ns = place.clock.now_ns()
    place.say("bob", Verb.CLAIM, 1)
    place.say("alice", Verb.CLAIM, 1)
    place.look()
    place.turned.clear()
    place.say("alice", Verb.GIVE, 2, "bob")
    place.look()
    assert place.turned == [None]
    assert place.site.requests.take() == UNLEASED
    place.site.state = State.HOLD
    place.look(wait_s=2.0)
    assert place.turned == [None]  # still driven
    place.site.state = State.READY
    place.site.channel.heard_ns = place.clock.now_ns()
    place.say("bob", Verb.CLAIM, 1)
    place.look(wait_s=0.9)
    assert place.turned == [None]  # its packets are not yet over
    place.look()
    assert place.turned == [None, f"farhand/{SESSION.name}/local/bob/state"]


def test_a_site_that_has_not_ticked_since_has_not_heeded_it() -> None:
    place = Place()
    place.say("alice", Verb.CLAIM, 1)
    place.look()
    place.say("bob", Verb.CLAIM, 1)
    place.say("alice", Verb.RELEASE, 2)
    for _ in range(5):
        place.look(ticks=0)
    assert place.turned[-1] is None
    place.look(ticks=2)
    assert place.turned[-1] == f"farhand/{SESSION.name}/local/bob/state"


def test_what_came_together_is_taken_in_order() -> None:
    """A release between two claims of one look: the link is turned all the same."""
    place = Place()
    place.say("alice", Verb.CLAIM, 1)
    place.look()
    place.say("alice", Verb.RELEASE, 2)
    place.say("alice", Verb.CLAIM, 3)
    place.look(ticks=0)
    assert place.turned[-1] is None
    place.look()
    assert place.turned[-1] == f"farhand/{SESSION.name}/local/alice/state"


def test_it_tells_once_a_second_and_at_once_of_what_changed() -> None:
    place = Place()
    for _ in range(20):
        place.look()
    assert len(place.out.statuses()) == 2
    place.say("alice", Verb.CLAIM, 1)
    place.look()
    (status,) = place.out.statuses()
    assert (status.holder, status.leased, status.dimension) == ("alice", True, 2)
    place.say("bob", Verb.TAKE, 9)
    place.look()
    (status,) = place.out.statuses()
    assert status.answers["bob"].epoch == "9"
    assert not status.answers["bob"].granted


def test_nonsense_changes_nothing() -> None:
    place = Place()
    place.ears["alice"](b"\xff{")
    place.ears["alice"](b'{"verb":"claim"}')
    place.look()
    assert place.turned == []


def test_a_session_without_names_is_left_alone_and_told_of() -> None:
    place = Place(names=())
    place.site.round_trip_s = 0.02
    place.look()
    (status,) = place.out.statuses()
    assert (status.leased, status.holder, status.round_trip_s) == (False, None, 0.02)
    assert place.turned == []
    assert place.site.requests.take() == 0


def told(holder: str | None, **refused: str) -> bytes:
    return encode_status(
        RemoteStatus("s", "1", "READY", 2, leased=True, holder=holder, refused=refused)
    )


def test_an_operators_site_waits_for_the_remotes_word_and_follows_it() -> None:
    site = SimpleNamespace(requests=OperatorRequests(), notices=deque[str]())
    ear, out = Words(), Words()
    claimant = LeaseClaimant("bob", 7, site, ear, out, DaemonLog("local"))  # type: ignore[arg-type]
    assert site.requests.take() == UNLEASED
    claimant.look()
    assert out.said == [encode_wish(Wish(Verb.CLAIM, 7))]
    ear(told("alice", bob="alice holds it"))
    claimant.look()
    claimant.look()
    assert claimant.trouble == "lease: refused, alice holds it"
    assert site.requests.take() == UNLEASED
    ear(told("alice", bob="alice holds it"))
    ear(told("bob"))
    claimant.look()
    assert claimant.trouble is None
    assert site.requests.take() == 0
    ear(b"nonsense")
    claimant.look()
    assert site.requests.take() == 0
    ear(told(None))
    claimant.look()
    assert site.requests.take() == UNLEASED
    assert list(site.notices) == [
        "lease: refused, alice holds it",
        "lease: bob holds the remote robot",
        "lease: not held",
    ]


def test_a_look_that_failed_ends_the_lease_through_rest() -> None:
    place = Place()
    place.say("alice", Verb.CLAIM, 1)
    place.look()
    place.site.state = State.ENGAGED
    place.keeper.look_failed()
    assert place.site.requests.take() == UNLEASED  # at once, and before any look succeeds
    place.look()
    place.site.state = State.READY
    place.say("alice", Verb.CLAIM, 1)
    place.look()
    assert place.turned[-2:] == [None, f"farhand/{SESSION.name}/local/alice/state"]
    assert list(place.site.notices)[2:] == [
        "lease: alice loses it: it could not be kept",
        "lease: alice holds it",
    ]


def test_without_names_a_look_that_failed_changes_nothing() -> None:
    place = Place(names=())
    place.keeper.look_failed()
    assert place.site.requests.take() == 0


def test_an_operators_site_whose_look_failed_drives_no_more_until_it_is_told_anew() -> None:
    site = SimpleNamespace(requests=OperatorRequests(), notices=deque[str]())
    ear, out = Words(), Words()
    claimant = LeaseClaimant("bob", 7, site, ear, out, DaemonLog("local"))  # type: ignore[arg-type]
    ear(told("bob"))
    claimant.look()
    assert claimant.holds
    claimant.look_failed()
    assert site.requests.take() == UNLEASED
    claimant.look()
    assert site.requests.take() == UNLEASED
    ear(told("bob"))
    claimant.look()
    assert site.requests.take() == 0
