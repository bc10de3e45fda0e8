from pathlib import Path

from channel.memory_link import memory_links
from local_site.controller import LocalController
from local_site.operators import HumanArm
from local_site.site import build_local_site
from site_runtime.assembly import Surroundings
from site_runtime.clock import ManualClock
from site_runtime.keys import SiteId
from site_runtime.session import load_session

EXPERIMENTS = Path(__file__).parents[2] / "experiments"


def test_the_site_is_built_as_the_session_file_says() -> None:
    session = load_session(EXPERIMENTS / "demo.toml")
    link = memory_links()[0]
    site = build_local_site(session, Surroundings(link, ManualClock(), 0, 1, lambda _: None))
    controller = site._controller
    assert site.identity is SiteId.LOCAL
    assert isinstance(controller, LocalController)
    assert controller.ramp_s == session.engagement.ramp_s
    assert tuple(controller.damping.task) == session.local.damping.task_n_s_per_m
    assert tuple(controller.coupling.stiffness) == session.coupling.stiffness_n_per_m
    assert isinstance(site._device._contact, HumanArm)
    assert site._obstacles_m == ()
