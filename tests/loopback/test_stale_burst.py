"""After an outage TCP delivers what it kept: seconds old, in order, faster than it was sent."""

from collections import defaultdict, deque

import numpy as np
import pytest

from channel.memory_link import MemoryLink
from site_runtime.keys import SiteId
from site_runtime.session import ChannelSettings
from site_runtime.supervisor import State
from tests.faults.wide_area import oldest_s
from tests.loopback.conftest import Pair, demo_session

OUTAGE_S = 2.0
AT_ONCE = 8  # packets a tick: the burst lasts some 0.3 s


def test_no_site_is_driven_by_what_an_outage_made_stale(monkeypatch: pytest.MonkeyPatch) -> None:
    pair = Pair(demo_session(ChannelSettings(), rate_hz=500))
    pair.run(0.8)
    assert pair.local.state is pair.remote.state is State.ENGAGED
    kept: defaultdict[MemoryLink, deque[bytes]] = defaultdict(deque)
    send = MemoryLink.send
    with monkeypatch.context() as tcp:
        tcp.setattr(MemoryLink, "send", lambda link, data: kept[link].append(data) or True)
        pair.run(OUTAGE_S)
        while any(kept.values()):
            for link, queue in kept.items():
                for _ in range(min(AT_ONCE, len(queue))):
                    send(link, queue.popleft())
            pair.tick()
            if all(len(queue) <= 1 for queue in kept.values()):
                break
    pair.run(2.0)
    longest_s = oldest_s(pair.session, pair.local.margin)
    for site in SiteId:
        rows = pair.rows(site, 6.0)
        age_s = (rows["stamp_ns"] - rows["used_stamp_ns"]) * 1e-9
        engaged = rows["state"] == State["ENGAGED"]
        assert age_s.max() > OUTAGE_S - 0.1, "the stale burst did come"
        assert np.count_nonzero(age_s > longest_s) > 50
        assert age_s[engaged].max() <= longest_s
        assert pair.sites[site].state is State.ENGAGED
