"""Who may drive the remote robot: one operator at a time, by what is wished and how time passes.

| from | to | when |
|---|---|---|
| free | held | somebody claims it: a chosen successor first, else who has waited longest |
| held | ending | its holder releases it or gives it to one who claims it, a supervisor takes it |
| held | ending | nothing of its holder for `expire_ns`, and the site is not ENGAGED |
| ending | free | the site is settled: outputs off, and the holder's packets over |

So between two holders the site always stands with its outputs off.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Final

CLAIM_NS: Final = 3_000_000_000
"""A claim not repeated for so long is none."""


class Verb(StrEnum):
    """What an operator may wish."""

    CLAIM = "claim"
    RELEASE = "release"
    GIVE = "give"
    TAKE = "take"


@dataclass(frozen=True, slots=True)
class Wish:
    """What an operator wants; `epoch` tells one run or command of his from the next, and grows."""

    verb: Verb
    epoch: int
    to: str | None = None


@dataclass(frozen=True, slots=True)
class Claim:
    """Since when somebody has wanted the robot, and when he last said so [ns]."""

    since_ns: int
    heard_ns: int


@dataclass(frozen=True, slots=True)
class LeaseRules:
    """After what silence a lease expires, and who may take it from another."""

    expire_ns: int
    supervisors: frozenset[str] = frozenset()


@dataclass(frozen=True, slots=True)
class Lease:
    """The lease of one robot. `rested` holds the epoch up to which a name's claims are withdrawn.

    `asked` holds the epoch of each name's newest wish other than a claim: each counts once.
    """

    holder: str | None = None
    since_ns: int = 0
    heard_ns: int = 0
    ending: bool = False
    successor: str | None = None
    claims: Mapping[str, Claim] = field(default_factory=dict)
    rested: Mapping[str, int] = field(default_factory=dict)
    asked: Mapping[str, int] = field(default_factory=dict)

    @property
    def obeyed(self) -> str | None:
        """Whose packets reach the robot."""
        return None if self.ending else self.holder

    @property
    def refused(self) -> dict[str, str]:
        """Who claims it and does not have it, and why."""
        reason = "nobody has it yet"
        if self.holder is not None:
            reason = f"{self.holder} {'is parting from it' if self.ending else 'holds it'}"
        return {name: reason for name in sorted(self.claims) if name != self.obeyed}


@dataclass(frozen=True, slots=True)
class Step:
    """The lease after something happened, what of it is to be audited, and whether it was done."""

    lease: Lease
    told: tuple[str, ...] = ()
    answer: str = ""
    granted: bool = True


def hear(lease: Lease, rules: LeaseRules, name: str, wish: Wish, now_ns: int) -> Step:
    """Return what a wish of `name` leads to; that it is his is for the caller to know."""
    if wish.verb is Verb.CLAIM:
        return _claim(lease, name, wish.epoch, now_ns)
    if wish.epoch <= lease.asked.get(name, 0):
        return Step(lease)
    lease = replace(lease, asked={**lease.asked, name: wish.epoch})
    if wish.verb is Verb.RELEASE:
        return _release(lease, name, wish.epoch)
    if wish.verb is Verb.GIVE:
        return _give(lease, name, wish.to)
    return _take(lease, rules, name, now_ns)


def look(
    lease: Lease,
    rules: LeaseRules,
    now_ns: int,
    *,
    heard_ns: int | None,
    engaged: bool,
    settled: bool,
) -> Step:
    """Return what time leads to. `heard_ns` is when the site heard its peer last.

    `settled` says that the site obeys nobody, its outputs are off and its peer is silent.
    """
    fresh = {n: c for n, c in lease.claims.items() if now_ns - c.heard_ns < CLAIM_NS}
    if len(fresh) != len(lease.claims):
        lease = replace(lease, claims=fresh)
    if (holder := lease.obeyed) is not None:
        if heard_ns is not None and heard_ns > max(lease.heard_ns, lease.since_ns):
            lease = replace(lease, heard_ns=heard_ns)
        silent_ns = now_ns - lease.heard_ns
        if silent_ns >= rules.expire_ns and not engaged:
            told = f"expired: nothing of {holder} for {silent_ns * 1e-9:.1f} s"
            claims = {name: claim for name, claim in fresh.items() if name != holder}
            return Step(replace(lease, claims=claims, ending=True), (told,))
        return Step(lease)
    if lease.holder is not None and not settled:
        return Step(lease)
    heir = lease.successor if lease.successor in fresh else _longest_waiting(fresh)
    if heir is None:
        return Step(replace(lease, holder=None, ending=False, successor=None))
    given = replace(
        lease, holder=heir, since_ns=now_ns, heard_ns=now_ns, ending=False, successor=None
    )
    return Step(given, (f"{heir} holds it",))


def revoke(lease: Lease, reason: str) -> Step:
    """Return the lease taken from whoever holds it, by nobody's wish."""
    if lease.obeyed is None:
        return Step(lease)
    return Step(replace(lease, ending=True), (f"{lease.obeyed} loses it: {reason}",))


def _claim(lease: Lease, name: str, epoch: int, now_ns: int) -> Step:
    if epoch <= lease.rested.get(name, 0):
        return Step(lease, answer="withdrawn", granted=False)
    before = lease.claims.get(name)
    claim = Claim(now_ns if before is None else before.since_ns, now_ns)
    claimed = replace(
        lease,
        claims={**lease.claims, name: claim},
        rested={other: at for other, at in lease.rested.items() if other != name},
        heard_ns=now_ns if name == lease.obeyed else lease.heard_ns,
    )
    told: tuple[str, ...] = ()
    if before is None:
        told = (f"{name} claims it",)
        if lease.holder not in (None, name):
            told = (f"{name} is refused: {claimed.refused[name]}",)
    return Step(claimed, told, claimed.refused.get(name, "you hold it"))


def _release(lease: Lease, name: str, epoch: int) -> Step:
    claims = {other: claim for other, claim in lease.claims.items() if other != name}
    lease = replace(lease, claims=claims, rested={**lease.rested, name: epoch})
    if lease.obeyed != name:
        return Step(lease, answer="your claim is withdrawn")
    return Step(replace(lease, ending=True), (f"{name} releases it",), "released")


def _give(lease: Lease, name: str, to: str | None) -> Step:
    if lease.obeyed != name:
        answer = "you do not hold it"
    elif to == name or to not in lease.claims:
        answer = f"{to} does not claim it" if to != name else "you hold it"
    else:
        told = f"{name} gives it to {to}"
        return Step(replace(lease, ending=True, successor=to), (told,), f"given to {to}")
    return Step(lease, (f"{name} may not give it to {to}: {answer}",), answer, granted=False)


def _take(lease: Lease, rules: LeaseRules, name: str, now_ns: int) -> Step:
    if name not in rules.supervisors:
        answer = "only a supervisor may take it"
        return Step(lease, (f"{name} may not take it: no supervisor",), answer, granted=False)
    if lease.obeyed == name:
        return Step(lease, answer="you hold it")
    # a supervisor without a site of his own takes it away all the same: it expires after him
    rested = {other: at for other, at in lease.rested.items() if other != name}
    claims = {name: Claim(now_ns, now_ns)} | dict(lease.claims)
    lease = replace(lease, claims=claims, rested=rested, successor=name)
    if lease.holder is None:
        return Step(lease, (f"{name} takes it",), "taken")
    told = f"{name} takes it from {lease.holder}"
    return Step(replace(lease, ending=True), (told,), "taken")


def _longest_waiting(claims: Mapping[str, Claim]) -> str | None:
    return min(claims, key=lambda name: (claims[name].since_ns, name), default=None)
