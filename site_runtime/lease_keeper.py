"""The remote site's side of the lease: hears claims, lets one operator through, tells how it is."""

from collections.abc import Callable, Mapping
from math import isfinite
from typing import Final, Protocol

from site_runtime.assembly import TAKEOVER_NS
from site_runtime.clock import Clock
from site_runtime.daemon_log import DaemonLog
from site_runtime.keeper import Keeper
from site_runtime.keys import SiteId, state_key
from site_runtime.lease import Lease, LeaseRules, Step, Verb, hear, look, revoke
from site_runtime.lease_messages import Answer, RemoteStatus, decode_wish, encode_status
from site_runtime.security.identity import Identity, Role
from site_runtime.session import Session
from site_runtime.site import Site
from site_runtime.supervisor import DRIVEN, State

LOOK_S: Final = 0.1
TELL_NS: Final = 1_000_000_000
_TICKS_TO_HEED: Final = 2


class Ear(Protocol):
    """What one operator says of the lease, and nobody else can."""

    def receive(self) -> list[tuple[str, bytes]]:
        """Return (key, payload) of what arrived since the last call."""
        ...


class Switch(Protocol):
    """The link, which can be turned to another peer."""

    def listen_to(self, peer_key: str | None) -> None:
        """Listen to another peer, or to none."""


def rules_of(session: Session, people: tuple[Identity, ...]) -> LeaseRules:
    """Return what the lease of a session's remote robot goes by."""
    supervisors = (one.person for one in people if one.role is Role.SUPERVISOR)
    return LeaseRules(
        round(session.network.operator_silence_s * 1e9),
        frozenset(name for name in supervisors if name is not None),
    )


class LeaseKeeper(Keeper):
    """Keeps the lease of one remote site from a thread of its own, in a `with` statement.

    `ears` are by operator; without any, whoever comes first is obeyed, and it only tells how the
    site is.
    """

    def __init__(
        self,
        session: Session,
        site: Site,
        epoch: int,
        clock: Clock,
        switch: Switch,
        ears: Mapping[str, Ear],
        rules: LeaseRules,
        publish: Callable[[bytes], None],
        log: DaemonLog,
    ) -> None:
        super().__init__("lease", LOOK_S, log)
        self._session = session
        self._site = site
        self._epoch = epoch
        self._clock = clock
        self._switch = switch
        self._ears = ears
        self._rules = rules
        self._publish = publish
        self._silence_ns = max(TAKEOVER_NS, round(session.engagement.hold_after_s * 1e9))
        self._lease = Lease()
        self._answers: dict[str, Answer] = {}
        self._obeyed: str | None = None
        self._deaf_ticks = 0
        self._told_ns: int | None = None
        if ears:
            site.requests.unleased = True
            switch.listen_to(None)

    @property
    def lease(self) -> Lease:
        """The lease as it stands."""
        return self._lease

    def look(self) -> None:
        """Take in what was said, let time pass, turn the link, tell people."""
        now_ns = self._clock.now_ns()
        changed = False
        for name, ear in self._ears.items():
            for _, payload in ear.receive():
                if (wish := decode_wish(payload)) is None:
                    continue
                new = wish.epoch > self._lease.asked.get(name, 0)
                step = self._take_in(hear(self._lease, self._rules, name, wish, now_ns))
                if wish.verb is not Verb.CLAIM and new:
                    self._answers[name] = Answer(str(wish.epoch), step.granted, step.answer)
                    changed = True
                self._turn()
        if self._ears:
            step = look(
                self._lease,
                self._rules,
                now_ns,
                heard_ns=self._site.channel.heard_ns,
                engaged=self._site.state is State.ENGAGED,
                settled=self._settled(now_ns),
            )
            self._take_in(step)
            changed |= self._turn() or bool(step.told)
        if changed or self._told_ns is None or now_ns - self._told_ns >= TELL_NS:
            self._told_ns = now_ns
            self._publish(encode_status(self.status(now_ns)))

    def look_failed(self) -> None:
        """Obey nobody until looks succeed: the lease ends, as a release would end it."""
        if self._ears:
            self._site.requests.unleased = True
            self._take_in(revoke(self._lease, "it could not be kept"))

    def status(self, now_ns: int) -> RemoteStatus:
        """Return what people are told."""
        site, lease = self._site, self._lease
        trip_s = site.round_trip_s
        held = lease.holder is not None
        return RemoteStatus(
            session=self._session.name,
            epoch=str(self._epoch),
            state=site.state.name,
            dimension=self._session.task.dimension,
            leased=bool(self._ears),
            holder=lease.obeyed,
            held_s=(now_ns - lease.since_ns) * 1e-9 if held else None,
            round_trip_s=trip_s if isfinite(trip_s) and trip_s >= 0.0 else None,
            refused=lease.refused,
            answers=dict(self._answers),
        )

    def _take_in(self, step: Step) -> Step:
        self._lease = step.lease
        self._site.notices.extend(f"lease: {text}" for text in step.told)
        return step

    def _turn(self) -> bool:
        """Let the link, and then the site, follow the lease; whether there was a change."""
        obeyed = self._lease.obeyed
        if obeyed == self._obeyed:
            return False
        self._obeyed = obeyed
        if obeyed is None:
            self._site.requests.unleased = True
            self._switch.listen_to(None)
            self._deaf_ticks = self._site.ticks
        else:
            self._switch.listen_to(state_key(self._session.name, SiteId.LOCAL, obeyed))
            self._site.requests.unleased = False
        return True

    def _settled(self, now_ns: int) -> bool:
        """Whether the site obeys nobody, is not driven, and would take another run for its peer."""
        site = self._site
        heard_ns = site.channel.heard_ns
        return (
            self._obeyed is None
            and site.ticks - self._deaf_ticks >= _TICKS_TO_HEED
            and site.state not in DRIVEN
            and (heard_ns is None or now_ns - heard_ns >= self._silence_ns)
        )
