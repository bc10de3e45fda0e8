"""Where a scenario is played, and what is seen of it afterwards."""

import re
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from enum import Enum
from itertools import groupby
from pathlib import Path

import numpy as np

from site_runtime.assembly import TAKEOVER_NS
from site_runtime.keys import SiteId
from site_runtime.supervisor import State
from tests.faults.invariants import TORQUE, among, violations
from tests.faults.network import ImpairedNetwork
from tests.faults.sites import BOTH, LOCAL, REMOTE, Daemon, NotReached, SitePair


class Setting(Enum):
    """What lies between the sites; the scenarios of one setting share its daemons."""

    LOOPBACK = "on loopback"
    ROUTER = "behind a router"
    NETWORK = "on an impaired network"


@dataclass(frozen=True, slots=True)
class Scenario:
    """A fault and what each site must do.

    `local` and `remote` are patterns of the states that a site passes through from the fault on;
    of a site that was restarted, those of its new run. The sites of `safe` must leave ENGAGED
    within `safe_within_s`. With `fit_after`, both must be ENGAGED for good in the end.
    """

    name: str
    setting: Setting
    act: Callable[["Stage"], None]
    local: str
    remote: str
    safe: tuple[SiteId, ...] = ()
    safe_within_s: float = 1.0
    fit_after: bool = True

    def pattern(self, site: SiteId) -> str:
        """The pattern for one site."""
        return self.local if site is LOCAL else self.remote


@dataclass
class Outcome:
    """What one play of a scenario showed.

    `violations` are never excused; `deviations` are states or times other than those expected,
    which a machine that stalls may cause too. `oldest_s` is the oldest peer sample that a site was
    driven by while ENGAGED, `longest_s` the longest loop, against the certified round trip.
    """

    scenario: Scenario
    states: dict[SiteId, str] = field(default_factory=dict)
    safe_s: dict[SiteId, float] = field(default_factory=dict)
    oldest_s: float = 0.0
    longest_s: float = 0.0
    beyond_s: float = 0.0
    notes: list[str] = field(default_factory=list)
    violations: list[str] = field(default_factory=list)
    deviations: list[str] = field(default_factory=list)


class Stage:
    """A pair of sites in a setting, and the instants and findings of the scenario being played."""

    def __init__(self, pair: SitePair, network: ImpairedNetwork | None) -> None:
        self.pair = pair
        self._network = network
        self.since_ns: dict[SiteId, int] = {}
        self.notes: list[str] = []
        self.violations: list[str] = []
        self.deviations: list[str] = []
        self._fit = True

    @property
    def network(self) -> ImpairedNetwork:
        """The network of an impaired setting."""
        assert self._network is not None
        return self._network

    def fault(self, *sites: SiteId, at_ns: int | None = None) -> int:
        """Say that the fault hits these sites, or both, now or then; return when [ns]."""
        at_ns = time.monotonic_ns() if at_ns is None else at_ns
        for site in sites or BOTH:
            self.since_ns[site] = at_ns
        return at_ns

    def play(self, scenario: Scenario) -> Outcome:
        """Bring both sites to ENGAGED, play a scenario, and judge what was seen."""
        self.since_ns, self.notes, self.violations, self.deviations = {}, [], [], []
        outcome = Outcome(
            scenario, notes=self.notes, violations=self.violations, deviations=self.deviations
        )
        begin_ns = time.monotonic_ns()
        try:
            self._make_fit()
            begin_ns = time.monotonic_ns()
            scenario.act(self)
            if scenario.fit_after:
                self.pair.until_steady()
                self._fit = True
        except NotReached as missed:
            outcome.deviations.append(str(missed))
        time.sleep(0.1)  # the last batch is on its way
        for site in BOTH:
            self._judge(site, begin_ns, outcome)
        outcome.violations.extend(
            f"{daemon.site.label} crashed: {daemon.text()}" for daemon in self.pair.crashed()
        )
        return outcome

    def never_driven(self, daemon: Daemon, who: str, *, waits_for_silence: bool = False) -> None:
        """It is a violation if a daemon has ever driven its robot, or ran too briefly to tell.

        One that waits for a silence of the holder's may, after such a silence.
        """
        rows = self.pair.rows_of(daemon)
        if len(rows) < 500:
            self.violations.append(f"{who} ran {len(rows)} ticks: nothing was tried")
        if among(rows, TORQUE).any():
            # a machine so busy that a peer is not heard for a second gives the robot away by rule
            silent = self._longest_hold_s(daemon.site.peer) > TAKEOVER_NS * 1e-9
            by_rule = waits_for_silence and silent
            (self.deviations if by_rule else self.violations).append(f"{who} drove its robot")

    def _longest_hold_s(self, site: SiteId) -> float:
        """Longest time [s] that a site has held, in its present run since the fault."""
        rows = self.pair.rows(site, self.since_ns.get(site, 0))
        holding = among(rows, ("HOLD", "READY", "ALIGNING"))
        edges = np.flatnonzero(np.diff(np.concatenate(([False], holding, [False]))))
        stamps_ns = rows["stamp_ns"]
        return max(
            (
                float(stamps_ns[last - 1] - stamps_ns[first]) * 1e-9
                for first, last in zip(edges[::2], edges[1::2], strict=True)
            ),
            default=0.0,
        )

    def never(self, site: SiteId, state: str, since_ns: int, what: str) -> None:
        """It is a violation if a site has been in a state since an instant."""
        rows = self.pair.rows(site, since_ns)
        count = np.count_nonzero(among(rows, (state,)))
        if count:
            self.violations.append(f"{site.label} {what}, for {count} ticks")

    def _make_fit(self) -> None:
        """Both sites ENGAGED, started again if the scenario before left one unfit."""
        if not self._fit:
            for site in BOTH:
                self.pair.kill(site)
            self.pair.start(*BOTH)
        self._fit = False
        self.pair.until_steady()

    def _judge(self, site: SiteId, begin_ns: int, outcome: Outcome) -> None:
        since_ns = self.since_ns.get(site, begin_ns)
        scenario, pair = outcome.scenario, self.pair
        rows = pair.rows(site, begin_ns)
        if not len(rows):
            outcome.states[site] = ""
            return
        outcome.violations.extend(violations(rows, pair.session, site))
        driven = rows[among(rows, ("ENGAGED",))]
        if len(driven):
            outcome.oldest_s = max(outcome.oldest_s, float(np.nanmax(driven["one_way_delay_s"])))
            trip_s = np.nan_to_num(driven["round_trip_s"])
            beyond = trip_s > driven["certified_round_trip_s"]
            outcome.longest_s = max(outcome.longest_s, float(trip_s.max()))
            outcome.beyond_s += float(np.count_nonzero(beyond)) * pair.session.period_ns * 1e-9
        after = rows[rows["stamp_ns"] >= since_ns]
        states = " ".join(State(value).name for value, _ in groupby(after["state"]))
        outcome.states[site] = states
        if not re.fullmatch(scenario.pattern(site), states):
            outcome.deviations.append(
                f"{site.label} went {states}, expected {scenario.pattern(site)}"
            )
        left = after["stamp_ns"][after["state"] != State["ENGAGED"]]
        if site in scenario.safe and len(left):
            outcome.safe_s[site] = float(left[0] - since_ns) * 1e-9
            if outcome.safe_s[site] > scenario.safe_within_s:
                outcome.deviations.append(
                    f"{site.label} was safe after {outcome.safe_s[site]:.3f} s, "
                    f"not within {scenario.safe_within_s} s"
                )
        elif site in scenario.safe:
            outcome.deviations.append(f"{site.label} never left ENGAGED")


@contextmanager
def opened(setting: Setting, folder: Path, seed: int = 1) -> Iterator[Stage]:
    """Both sites started in a setting, for one scenario after the other."""
    network = ImpairedNetwork(seed) if setting is Setting.NETWORK else None
    try:
        pair = SitePair(folder, network=network, routed=setting is Setting.ROUTER)
        try:
            pair.start(REMOTE, LOCAL)
            yield Stage(pair, network)
        finally:
            pair.close()
    finally:
        if network is not None:
            network.close()
