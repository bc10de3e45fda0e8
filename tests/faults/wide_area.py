"""Both sites on networks as there are, each with its profile: how old what they use is, as a table.

python -m tests.faults.wide_area [--seconds 20] [--only NAME]
"""

import argparse
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from site_runtime.keys import SiteId
from site_runtime.margin import Margin, margin_of
from site_runtime.session import Session
from site_runtime.supervisor import State
from telemetry.rows import RowArray
from tests.faults import namespace
from tests.faults.invariants import among, violations
from tests.faults.network import CLEAR, ImpairedNetwork, Impairment
from tests.faults.sites import BOTH, NotReached, SitePair

BLACKOUT_S = 3.0
BOTTLENECK_BIT_S = 1e6  # a site sends some 1.7 Mbit/s at 1 kHz
SETTLE_S = 1.0  # not counted after a change


@dataclass(frozen=True, slots=True)
class Network:
    """A kind of network, each way, and the profile for it."""

    name: str
    profile: str
    impairment: Impairment


NETWORKS = (
    Network("lan", "lan", CLEAR),
    Network("5 ± 5 ms, 1 % lost", "wifi", Impairment(0.005, 0.005, loss=0.01)),
    Network("50 ± 5 ms, 0.1 % lost", "wan", Impairment(0.05, 0.005, loss=0.001)),
    Network("50 ± 20 ms, 2 % lost", "lossy", Impairment(0.05, 0.02, loss=0.02)),
)
PROTOCOLS = ("tcp", "udp", "tls", "sealed")


@dataclass
class Seen:
    """What both sites saw: ages of the samples in use and of the loop [s], and their states.

    `holds` counts how often a site left ENGAGED on the bad network itself, `engaged` the share of
    ticks there in ENGAGED. Of the outage: how long until both had left ENGAGED from its start, and
    until both were ENGAGED again from its end. `violations` are never excused.
    """

    age_s: np.ndarray
    loop_s: np.ndarray
    holds: int
    engaged: float
    to_hold_s: float
    to_engaged_s: float
    violations: list[str]

    def ages_ms(self) -> tuple[float, float]:
        """Median and 99th percentile of the age of the samples in use."""
        return _percentiles_ms(self.age_s)

    def loops_ms(self) -> tuple[float, float]:
        """The same of the loop."""
        return _percentiles_ms(self.loop_s)


def stale(rows: RowArray, session: Session, margin: Margin) -> list[str]:
    """Return what is wrong with the samples that a site was driven by while ENGAGED.

    By the true ages: all stamps are of one clock here. None may be older than what the smallest
    share worth having is proven for, and none from the future.
    """
    driven = rows[among(rows, ("ENGAGED",)) & (rows["used_stamp_ns"] != 0)]
    age_ns = driven["stamp_ns"] - driven["used_stamp_ns"]
    on_the_way_ns = driven["used_arrival_ns"] - driven["used_stamp_ns"]
    longest_ns = oldest_s(session, margin) * 1e9
    checks = (
        (age_ns > longest_ns, "driven by a sample older than any share is proven for"),
        (on_the_way_ns < 0, "driven by a sample from the future"),
        (driven["used_arrival_ns"] > driven["stamp_ns"], "driven by a sample before it came"),
    )
    return [f"{what}, in {np.count_nonzero(bad)} ticks" for bad, what in checks if bad.any()]


def oldest_s(session: Session, margin: Margin) -> float:
    """Return the age of the loop at which only `derate_to` of the gains is proven [s]."""
    low_s, high_s = 0.0, 60.0
    while high_s - low_s > 1e-4:
        middle_s = (low_s + high_s) / 2
        enough = margin.share(round(middle_s * 1e9)) >= session.engagement.derate_to
        low_s, high_s = (middle_s, high_s) if enough else (low_s, middle_s)
    return high_s + 2e-9 * session.period_ns


def play(
    network: Network, protocol: str, seconds: float, *, routed: bool = False, seed: int = 1
) -> Seen:
    """Engage on a clear network, then the bad one for a while, then an outage of it.

    The outage is a blackout, or, `routed`, the death of the router, which comes back.
    """
    with (
        tempfile.TemporaryDirectory(prefix="farhand-wide-") as folder,
        ImpairedNetwork(seed) as wire,
    ):
        pair = SitePair(
            Path(folder), network=wire, routed=routed, protocol=protocol, profile=network.profile
        )
        try:
            pair.start(*BOTH)
            pair.until_steady()
            begin_ns = wire.impair(network.impairment)
            time.sleep(SETTLE_S + seconds)
            cut_ns = _outage(pair, wire, routed)
            time.sleep(BLACKOUT_S)
            back_ns = _restore(pair, wire, routed, network.impairment)
            to_engaged_s = _until_engaged(pair, back_ns)
            time.sleep(SETTLE_S)
            return _judge(pair, begin_ns, cut_ns, to_engaged_s)
        finally:
            pair.close()


def narrow(adapt: bool, seconds: float, seed: int = 1) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Meet a bottleneck of half of what is sent, each way, for a while; then the wide path again.

    Returns the age of the samples in use at each tick of the local site [s], and when, from the
    start of the bottleneck [s]; and what is wrong.
    """
    with (
        tempfile.TemporaryDirectory(prefix="farhand-wide-") as folder,
        ImpairedNetwork(seed) as wire,
    ):
        pair = SitePair(
            Path(folder), network=wire, protocol="udp", channel={"adapt_send_rate": adapt}
        )
        try:
            pair.start(*BOTH)
            pair.until_steady()
            begin_ns = wire.impair(Impairment(0.01, rate_bit_s=BOTTLENECK_BIT_S))
            time.sleep(seconds)
            wire.impair(Impairment(0.01))
            time.sleep(seconds)
            rows = pair.rows(SiteId.LOCAL, begin_ns)
            wrong = violations(rows, pair.session, SiteId.LOCAL)
            wrong += stale(rows, pair.session, margin_of(pair.session))
            used = rows[rows["used_stamp_ns"] != 0]
            ages_s = (used["stamp_ns"] - used["used_stamp_ns"]) * 1e-9
            return ages_s, (used["stamp_ns"] - begin_ns) * 1e-9, wrong
        finally:
            pair.close()


def _outage(pair: SitePair, wire: ImpairedNetwork, routed: bool) -> int:
    if not routed:
        return wire.impair(Impairment(blackout=True))
    pair.kill_router()
    return time.monotonic_ns()


def _restore(pair: SitePair, wire: ImpairedNetwork, routed: bool, impairment: Impairment) -> int:
    if not routed:
        return wire.impair(impairment)
    pair.start_router()
    return time.monotonic_ns()


def _until_engaged(pair: SitePair, since_ns: int) -> float:
    def engaged(site: SiteId) -> bool:
        return bool((pair.rows(site, since_ns)["state"] == State["ENGAGED"]).any())

    pair.until(lambda: all(map(engaged, BOTH)), "both ENGAGED again")
    return max(
        float(rows["stamp_ns"][np.argmax(rows["state"] == State["ENGAGED"])] - since_ns) * 1e-9
        for rows in (pair.rows(site, since_ns) for site in BOTH)
    )


def _judge(pair: SitePair, begin_ns: int, cut_ns: int, to_engaged_s: float) -> Seen:
    ages_s, loops_s, engaged, wrong = [], [], [], []
    holds, to_hold_s, margin = 0, 0.0, margin_of(pair.session)
    first_ns = begin_ns + round(SETTLE_S * 1e9)
    for site in BOTH:
        rows = pair.rows(site, begin_ns)
        wrong += violations(rows, pair.session, site)
        wrong += [f"{site.label}: {what}" for what in stale(rows, pair.session, margin)]
        bad = rows[(rows["stamp_ns"] >= first_ns) & (rows["stamp_ns"] < cut_ns)]
        used = bad[bad["used_stamp_ns"] != 0]
        ages_s.append((used["stamp_ns"] - used["used_stamp_ns"]) * 1e-9)
        loops_s.append(bad["round_trip_s"][np.isfinite(bad["round_trip_s"])])
        is_engaged = among(bad, ("ENGAGED",))
        engaged.append(is_engaged)
        holds += int(np.count_nonzero(is_engaged[:-1] & ~is_engaged[1:]))
        after = rows[rows["stamp_ns"] >= cut_ns]
        left = after["stamp_ns"][~among(after, ("ENGAGED",))]
        to_hold_s = max(to_hold_s, float(left[0] - cut_ns) * 1e-9 if len(left) else np.inf)
    wrong += [f"{daemon.site.label} crashed: {daemon.text()}" for daemon in pair.crashed()]
    return Seen(
        np.concatenate(ages_s),
        np.concatenate(loops_s),
        holds,
        float(np.concatenate(engaged).mean()),
        to_hold_s,
        to_engaged_s,
        wrong,
    )


def _percentiles_ms(values_s: np.ndarray) -> tuple[float, float]:
    if not len(values_s):
        return np.nan, np.nan
    p50, p99 = np.percentile(values_s, (50, 99)) * 1e3
    return float(p50), float(p99)


HEAD = (
    "| network, each way | profile | over | age of the sample in use: p50, p99 [ms] "
    "| of the loop: p50, p99 [ms] | ENGAGED [%] | left ENGAGED | after the cut: HOLD [ms] "
    "| ENGAGED again [s] |\n|---|---|---|---|---|---|---|---|---|"
)


def row(network: Network, over: str, seen: Seen) -> str:
    """One line of the table."""
    cells = (
        network.name,
        f"`{network.profile}`",
        over,
        "{:.0f}, {:.0f}".format(*seen.ages_ms()),
        "{:.0f}, {:.0f}".format(*seen.loops_ms()),
        f"{100 * seen.engaged:.1f}",
        str(seen.holds),
        f"{seen.to_hold_s * 1e3:.0f}",
        f"{seen.to_engaged_s:.2f}",
    )
    return "| " + " | ".join(cells) + " |"


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--only", action="append", help="a profile's name; repeatable")
    options = parser.parse_args(arguments)
    if namespace.refusal() is not None:
        parser.error(f"it needs an impaired network: {namespace.refusal()}")
    sys.stdout.write(HEAD + "\n")
    for network in NETWORKS:
        if options.only is not None and network.profile not in options.only:
            continue
        for protocol, routed in (*((one, False) for one in PROTOCOLS), ("tcp", True)):
            over = f"{protocol}, a router" if routed else protocol
            try:
                seen = play(network, protocol, options.seconds, routed=routed)
            except NotReached as missed:
                sys.stderr.write(f"{network.name} over {over}: {missed}\n")
                continue
            for wrong in seen.violations:
                sys.stderr.write(f"{network.name} over {over}: {wrong}\n")
            sys.stdout.write(row(network, over, seen) + "\n")
            sys.stdout.flush()


if __name__ == "__main__":
    main()
