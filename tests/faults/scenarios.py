"""The table of faults: what is done, and what each site must do."""

import signal
import time
from collections.abc import Callable
from dataclasses import replace

from site_runtime.keys import SiteId
from tests.faults.hostile import Intruder, nonsense
from tests.faults.network import BOTH_WAYS, CLEAR, Impairment, flap
from tests.faults.session import STIFFNESS_N_PER_M
from tests.faults.sites import BOTH, LOCAL, REMOTE
from tests.faults.stage import Scenario, Setting, Stage

Act = Callable[[Stage], None]

HELD_S = 0.4
SUSPENDED_S = 1.0
IMPAIRED_S = 3.0
FLOOD_HZ = 50_000.0
FLOOD_S = 2.0
HOUR_S = 3600.0

# patterns of states
RESUMED = "(ENGAGED )?HOLD ENGAGED( HOLD ENGAGED)?"
UNDISTURBED = "ENGAGED"
HELD = "ENGAGED HOLD ENGAGED"
HELD_ONCE_OR_TWICE = "ENGAGED HOLD ENGAGED( HOLD ENGAGED)?"
SHAKEN = "ENGAGED( HOLD ENGAGED)*"
HELD_AND_SHAKEN = "ENGAGED( HOLD ENGAGED)+"
BACK = "READY( ALIGNING)? ENGAGED( HOLD ENGAGED)*"
KEPT_OUT = "READY"
STOPPED = "(ENGAGED )?EMERGENCY_STOP READY( ALIGNING)? ENGAGED"
STILL_HELD = "ENGAGED HOLD"


def killed(site: SiteId) -> Act:
    """SIGKILL, and after a while a new start where it was."""

    def act(stage: Stage) -> None:
        since_ns = stage.fault()
        stage.pair.kill(site)
        stage.pair.until_left(site.peer, since_ns)
        time.sleep(HELD_S)
        stage.pair.start(site)

    return act


def moved(site: SiteId) -> Act:
    """SIGKILL, and a new start on another port; it dials, for nobody knows where it is now."""

    def act(stage: Stage) -> None:
        since_ns = stage.fault()
        stage.pair.kill(site)
        stage.pair.until_left(site.peer, since_ns)
        stage.pair.move(site)
        stage.pair.start(site, dial_peer=True)

    return act


def suspended(site: SiteId) -> Act:
    """SIGSTOP, and SIGCONT to all that its peer has sent meanwhile."""

    def act(stage: Stage) -> None:
        pair = stage.pair
        since_ns = stage.fault()
        pair.signal(site, signal.SIGSTOP)
        pair.until_left(site.peer, since_ns)
        time.sleep(SUSPENDED_S)
        stage.fault(site)
        pair.signal(site, signal.SIGCONT)
        pair.until_left(site, stage.since_ns[site])

    return act


def stopped(site: SiteId) -> Act:
    """The operator of one site stops both; then both operators reset."""

    def act(stage: Stage) -> None:
        pair = stage.pair
        since_ns = stage.fault()
        pair.signal(site, signal.SIGUSR1)
        for each in BOTH:
            pair.until_left(each, since_ns)
        time.sleep(HELD_S)
        for each in BOTH:
            pair.signal(each, signal.SIGUSR2)

    return act


def router_restarted(stage: Stage) -> None:
    """The router is killed and comes back."""
    since_ns = stage.fault()
    stage.pair.kill_router()
    for site in BOTH:
        stage.pair.until_left(site, since_ns)
    time.sleep(HELD_S)
    stage.pair.start_router()


def wall_clock_stepped(site: SiteId) -> Act:
    """An hour ahead, an hour behind, and right again, of one site."""

    def act(stage: Stage) -> None:
        clock = stage.pair.clocks[site]
        asked = clock.asked
        stage.fault()
        for offset_s in (HOUR_S, -HOUR_S, 0.0):
            clock.set(offset_s)
            time.sleep(0.7)
        stage.notes.append(f"asked for the wall clock {clock.asked - asked} times meanwhile")

    return act


def second_local(stage: Stage) -> None:
    """Another local site comes to a remote one that has its peer."""
    pair = stage.pair
    stage.fault()
    second = pair.start_second(LOCAL)
    time.sleep(2.0)
    stage.never_driven(second, "the second local", waits_for_silence=True)
    pair.end(second)


def second_local_in_wait(stage: Stage) -> None:
    """Another local site is there while the first is silent for half a second."""
    pair = stage.pair
    second = pair.start_second(LOCAL)
    since_ns = stage.fault()
    pair.signal(LOCAL, signal.SIGSTOP)
    pair.until_left(REMOTE, since_ns)
    time.sleep(0.4)
    stage.fault(LOCAL)
    pair.signal(LOCAL, signal.SIGCONT)
    time.sleep(2.0)
    stage.never_driven(second, "the second local", waits_for_silence=True)
    pair.end(second)


def other_session(stage: Stage) -> None:
    """The local site comes back with a session file of other gains."""
    pair = stage.pair
    since_ns = stage.fault()
    pair.kill(LOCAL)
    pair.until_left(REMOTE, since_ns)
    ours = pair.files[LOCAL]
    pair.files[LOCAL] = pair.write_session(LOCAL, stiffness_n_per_m=STIFFNESS_N_PER_M + 1.0)
    try:
        pair.start(LOCAL)
    finally:
        pair.files[LOCAL] = ours
    began = {site: pair.rows(site)["rejected"][-1].sum() for site in BOTH}
    pair.until(
        lambda: all(pair.rows(s)["rejected"][-1].sum() > began[s] + 1000 for s in BOTH),
        "both sites refuse the other's packets",
    )
    stage.never_driven(pair.daemons[LOCAL], "a site with another session file")


def replay_to_live(stage: Stage) -> None:
    """What both sites said a moment ago, and what an earlier local run said, said again."""
    pair = stage.pair
    with Intruder(pair.endpoint(LOCAL), pair.endpoint(REMOTE)) as intruder:
        earlier = intruder.record(LOCAL, 1.0)
        pair.kill(LOCAL)
        pair.start(LOCAL)
        pair.until_steady()
        now = {site: intruder.record(site, 0.5) for site in BOTH}
        stage.fault()
        intruder.play(LOCAL, earlier)
        for site in BOTH:
            intruder.play(site, now[site])


def replay_to_left(stage: Stage) -> None:
    """What the local's last two runs said, said again to the remote site that they left."""
    pair = stage.pair
    with Intruder(pair.endpoint(LOCAL), pair.endpoint(REMOTE)) as intruder:
        earlier = intruder.record(LOCAL, 1.0)
        pair.kill(LOCAL)
        pair.start(LOCAL)
        pair.until_steady()
        last = intruder.record(LOCAL, 0.5)
        since_ns = stage.fault()
        pair.kill(LOCAL)
        pair.until_left(REMOTE, since_ns)
        held_ns = time.monotonic_ns()
        for packets in (last, earlier):
            intruder.play(LOCAL, packets)
        stage.never(REMOTE, "ENGAGED", held_ns, "engaged on a recording")


def replay_to_lone(stage: Stage) -> None:
    """What the local site said to another remote run, said to one that has no peer."""
    pair = stage.pair
    with Intruder(pair.endpoint(LOCAL), pair.endpoint(REMOTE)) as intruder:
        recording = intruder.record(LOCAL, 1.0)
        pair.kill(LOCAL)
        pair.kill(REMOTE)
        stage.fault()
        pair.start(REMOTE)
        before = len(pair.rows(REMOTE))
        intruder.play(LOCAL, recording)
        intruder.play(LOCAL, recording)
        pair.until(lambda: len(pair.rows(REMOTE)) > before + 1000, "a second of the remote site")
        stage.never_driven(pair.daemons[REMOTE], "a site that heard only a recording")


def flooded(name: SiteId) -> Act:
    """Random bytes and packets of runs that never were, in one site's name."""

    def act(stage: Stage) -> None:
        pair = stage.pair
        packets = nonsense(1, name, pair.session.digest)
        with Intruder(pair.endpoint(name.peer)) as intruder:
            intruder.record(name.peer, 0.0)  # connected
            since_ns = stage.fault()
            rate_hz = intruder.flood(name, packets, FLOOD_HZ, FLOOD_S)
        time.sleep(0.2)
        rejected = pair.rows(name.peer, since_ns)["rejected"].sum(axis=1)
        came_hz = (int(rejected[-1]) - int(rejected[0])) / FLOOD_S
        stage.notes.append(f"{rate_hz:.0f} Hz sent, {came_hz:.0f} Hz taken in and refused")
        if came_hz < 1000.0:
            stage.violations.append("the flood did not reach the site: nothing was tried")

    return act


def impaired(impairment: Impairment, duration_s: float = IMPAIRED_S) -> Act:
    """The network is so for a while, both ways."""

    def act(stage: Stage) -> None:
        stage.fault(at_ns=stage.network.impair(impairment, BOTH_WAYS))
        time.sleep(duration_s)
        stage.network.impair(CLEAR)

    return act


def flapping(stage: Stage) -> None:
    """The link goes and comes every 0.3 s, for 5 s."""
    stage.fault(at_ns=flap(stage.network, 0.3, 5.0))


BLACKOUT = Impairment(blackout=True)
WIDE = Impairment(delay_s=0.05, jitter_s=0.02)
ON_LOOPBACK, ROUTED, IMPAIRED = Setting.LOOPBACK, Setting.ROUTER, Setting.NETWORK

SCENARIOS = (
    Scenario("local killed", ON_LOOPBACK, killed(LOCAL), BACK, HELD, (REMOTE,)),
    Scenario("remote killed", ON_LOOPBACK, killed(REMOTE), HELD, BACK, (LOCAL,)),
    Scenario("local on a new port", ON_LOOPBACK, moved(LOCAL), BACK, HELD, (REMOTE,)),
    Scenario("remote on a new port", ON_LOOPBACK, moved(REMOTE), HELD, BACK, (LOCAL,)),
    Scenario("local suspended", ON_LOOPBACK, suspended(LOCAL), RESUMED, HELD_ONCE_OR_TWICE, BOTH),
    Scenario("remote suspended", ON_LOOPBACK, suspended(REMOTE), HELD_ONCE_OR_TWICE, RESUMED, BOTH),
    Scenario(
        "local wall clock steps", ON_LOOPBACK, wall_clock_stepped(LOCAL), UNDISTURBED, UNDISTURBED
    ),
    Scenario(
        "remote wall clock steps", ON_LOOPBACK, wall_clock_stepped(REMOTE), UNDISTURBED, UNDISTURBED
    ),
    Scenario("local operator stops", ON_LOOPBACK, stopped(LOCAL), STOPPED, STOPPED, BOTH),
    Scenario("remote operator stops", ON_LOOPBACK, stopped(REMOTE), STOPPED, STOPPED, BOTH),
    Scenario("second local", ON_LOOPBACK, second_local, UNDISTURBED, UNDISTURBED),
    Scenario(
        "second local in wait", ON_LOOPBACK, second_local_in_wait, RESUMED, HELD_AND_SHAKEN,
        (REMOTE,),
    ),
    Scenario("recording to live sites", ON_LOOPBACK, replay_to_live, UNDISTURBED, UNDISTURBED),
    Scenario("flood in the local's name", ON_LOOPBACK, flooded(LOCAL), SHAKEN, SHAKEN),
    Scenario("flood in the remote's name", ON_LOOPBACK, flooded(REMOTE), SHAKEN, SHAKEN),
    Scenario(
        "another session file", ON_LOOPBACK, other_session, KEPT_OUT, STILL_HELD, (REMOTE,),
        fit_after=False,
    ),
    Scenario(
        "recording to a site that was left", ON_LOOPBACK, replay_to_left, "", STILL_HELD, (REMOTE,),
        fit_after=False,
    ),
    Scenario(
        "recording to a lone site", ON_LOOPBACK, replay_to_lone, "", KEPT_OUT, fit_after=False
    ),
    Scenario("router restarted", ROUTED, router_restarted, HELD_AND_SHAKEN, HELD_AND_SHAKEN, BOTH),
    Scenario("50 ± 20 ms", IMPAIRED, impaired(WIDE), SHAKEN, SHAKEN),
    Scenario("50 ± 20 ms, 2 % lost", IMPAIRED, impaired(replace(WIDE, loss=0.02)), SHAKEN, SHAKEN),
    Scenario("50 ± 20 ms, 20 % lost", IMPAIRED, impaired(replace(WIDE, loss=0.2)), SHAKEN, SHAKEN),
    Scenario("10 % reordered", IMPAIRED, impaired(Impairment(0.02, reorder=0.1)), SHAKEN, SHAKEN),
    Scenario("10 % doubled", IMPAIRED, impaired(Impairment(0.01, duplicate=0.1)), SHAKEN, SHAKEN),
    Scenario("1 Mbit/s", IMPAIRED, impaired(Impairment(0.01, rate_bit_s=1e6)), SHAKEN, SHAKEN),
    Scenario("blackout of 0.05 s", IMPAIRED, impaired(BLACKOUT, 0.05), SHAKEN, SHAKEN),
    Scenario(
        "blackout of 0.5 s", IMPAIRED, impaired(BLACKOUT, 0.5), HELD_AND_SHAKEN, HELD_AND_SHAKEN,
        BOTH,
    ),
    Scenario(
        "blackout of 3 s", IMPAIRED, impaired(BLACKOUT, 3.0), HELD_AND_SHAKEN, HELD_AND_SHAKEN, BOTH
    ),
    Scenario("link flaps every 0.3 s", IMPAIRED, flapping, HELD_AND_SHAKEN, HELD_AND_SHAKEN, BOTH),
)  # fmt: skip
