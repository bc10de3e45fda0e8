"""Both sites on one clock turned by hand, each of them to be silenced, restarted or left alone."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest

from channel.delay import ConstantDelay, DelayModel, Direction
from channel.memory_link import MemoryLink, memory_links
from local_site.site import build_local_site
from remote_site.site import build_remote_site
from site_runtime.assembly import Surroundings
from site_runtime.clock import ManualClock
from site_runtime.keys import SiteId
from site_runtime.session import (
    ChannelSettings,
    EngagementSettings,
    LoopSettings,
    ManipulabilityTask,
    NoOperator,
    Session,
    load_session,
)
from site_runtime.site import Site
from telemetry.rows import RowArray

EXPERIMENTS = Path(__file__).parents[2] / "experiments"
BUILD = {SiteId.LOCAL: build_local_site, SiteId.REMOTE: build_remote_site}
ENGAGEMENT = EngagementSettings(
    alignment="none", ramp_s=0.3, sub_task_ramp_s=0.3, hold_after_s=0.05, blend_s=0.2
)


def both_ways(delay: DelayModel, **effects: object) -> ChannelSettings:
    """The same delay and the same effects in both directions, by timestamps."""
    direction = Direction(delay, **effects)  # type: ignore[arg-type]
    return ChannelSettings("exact", None, direction, direction)


def demo_session(
    channel: ChannelSettings | None = None, *, rate_hz: int = 1000, **changes: object
) -> Session:
    """The demo's arms and gains in free motion: no hand, no wall, no post, bent by itself."""
    demo = load_session(EXPERIMENTS / "demo.toml")
    free = replace(
        demo,
        loop=LoopSettings(rate_hz),
        engagement=ENGAGEMENT,
        channel=channel or both_ways(ConstantDelay(0.03)),
        local=replace(demo.local, operator=NoOperator("none")),
        remote=replace(
            demo.remote,
            device=replace(demo.remote.device, initial_position_rad=(1.5, -0.9, -1.9)),
            environment=replace(demo.remote.environment, walls=()),
            sub_tasks=(ManipulabilityTask("manipulability", 2.0),),
        ),
    )
    return replace(free, **changes)  # type: ignore[arg-type]


@dataclass
class Pair:
    """Two sites; `tick` moves time on by one period and ticks those named."""

    session: Session
    remote_session: Session | None = None
    clock: ManualClock = field(default_factory=ManualClock)
    sites: dict[SiteId, Site] = field(default_factory=dict)
    links: dict[SiteId, MemoryLink] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.links[SiteId.LOCAL], self.links[SiteId.REMOTE] = memory_links()
        for epoch, site in enumerate(SiteId, start=1):
            self.start(site, epoch)

    def start(self, site: SiteId, epoch: int) -> None:
        """Start a site afresh: a new process, its robot where the session file puts it."""
        session = self.session
        if site is SiteId.REMOTE and self.remote_session is not None:
            session = self.remote_session
        surroundings = Surroundings(
            self.links[site], self.clock, self.clock.now_ns(), epoch, lambda _: None
        )
        self.sites[site] = BUILD[site](session, surroundings)
        self.sites[site].open()

    @property
    def local(self) -> Site:
        return self.sites[SiteId.LOCAL]

    @property
    def remote(self) -> Site:
        return self.sites[SiteId.REMOTE]

    def tick(self, *sites: SiteId) -> None:
        self.clock.sleep_until_ns(self.clock.now_ns() + self.session.period_ns)
        for site in sites or tuple(SiteId):
            self.sites[site].tick()
            self.sites[site].telemetry.flush()

    def run(self, duration_s: float, *sites: SiteId) -> None:
        for _ in range(round(duration_s * self.session.loop.rate_hz)):
            self.tick(*sites)

    def rows(self, site: SiteId, duration_s: float) -> RowArray:
        """The newest rows of a site, at most as many as its ring holds."""
        return self.sites[site].telemetry.last(round(duration_s * self.session.loop.rate_hz))

    def error_m(self) -> float:
        """Distance between the end effectors now."""
        ends = [self.sites[site].telemetry.last(1)["position_m"][0] for site in SiteId]
        return float(np.linalg.norm(ends[0] - ends[1]))


@pytest.fixture
def make_session() -> Callable[..., Session]:
    return demo_session


@pytest.fixture
def make_pair() -> Callable[..., Pair]:
    return Pair


@pytest.fixture
def make_channel() -> Callable[..., ChannelSettings]:
    return both_ways
