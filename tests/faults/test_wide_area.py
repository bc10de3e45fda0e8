"""Two sites across a wide and lossy network: what they use is never stale, and they come back."""

import numpy as np
import pytest

from tests.faults import namespace
from tests.faults.sites import NotReached
from tests.faults.wide_area import NETWORKS, Seen, narrow, play

pytestmark = [
    pytest.mark.processes,
    pytest.mark.skipif(namespace.refusal() is not None, reason=str(namespace.refusal() or "")),
]

LAN = next(network for network in NETWORKS if network.profile == "lan")
LOSSY = next(network for network in NETWORKS if network.profile == "lossy")
TRIES = 3  # a machine that stalls makes the sites hold longer than the network does


def good(seen: Seen) -> bool:
    """Whether times and ages are what the network asks for, with room for a busy machine."""
    p50_ms, p99_ms = seen.ages_ms()
    return (
        30.0 < p50_ms < 150.0
        and p99_ms < 600.0
        and seen.engaged > 0.5
        and 0.0 < seen.to_hold_s < 1.0
        and seen.to_engaged_s < 10.0
    )


@pytest.mark.parametrize(("protocol", "routed"), [("udp", False), ("sealed", False), ("tcp", True)])
def test_an_outage_of_a_lossy_network_leads_to_hold_and_back(protocol: str, routed: bool) -> None:
    told = []
    for seed in range(TRIES):
        try:
            seen = play(LOSSY, protocol, 2.0, routed=routed, seed=seed + 1)
        except NotReached as missed:
            told.append(str(missed))
            continue
        assert not seen.violations, "\n".join(seen.violations)
        if good(seen):
            return
        told.append(f"{seen.ages_ms()} {seen.engaged} {seen.to_hold_s} {seen.to_engaged_s}")
    pytest.fail("\n".join(told))


def test_a_lan_that_was_cut_comes_back_over_udp_before_two_handshakes_have_timed_out() -> None:
    """The handshake that the outage swallowed must not be waited for as long as on a WAN."""
    told = []
    for seed in range(TRIES):
        try:
            seen = play(LAN, "udp", 0.5, seed=seed + 1)
        except NotReached as missed:
            told.append(str(missed))
            continue
        assert not seen.violations, "\n".join(seen.violations)
        if seen.to_engaged_s < 2.0:
            return
        told.append(f"{seen.to_engaged_s} s")
    pytest.fail("\n".join(told))


def test_an_adapting_send_rate_keeps_a_bottleneck_s_queue_short() -> None:
    told = []
    for seed in range(TRIES):
        ages_s, times_s, wrong = narrow(True, 6.0, seed=seed + 1)
        assert not wrong, "\n".join(wrong)
        during = ages_s[(times_s > 3.0) & (times_s < 6.0)]
        after = ages_s[times_s > 8.0]
        told.append(f"{np.median(during)} {np.median(after)}")
        if np.median(during) < 0.1 and np.median(after) < 0.05:
            return
    pytest.fail("\n".join(told))
