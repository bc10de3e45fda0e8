from pathlib import Path

from channel.memory_link import memory_links
from control_law.sub_tasks.composite import NormLimiter
from remote_site.controller import RemoteController
from remote_site.environments import Walls
from remote_site.site import build_remote_site
from site_runtime.assembly import Surroundings
from site_runtime.clock import ManualClock
from site_runtime.keys import SiteId
from site_runtime.session import load_session

EXPERIMENTS = Path(__file__).parents[2] / "experiments"


def test_the_site_is_built_as_the_session_file_says() -> None:
    session = load_session(EXPERIMENTS / "demo.toml")
    link = memory_links()[0]
    site = build_remote_site(session, Surroundings(link, ManualClock(), 0, 1, lambda _: None))
    controller = site._controller
    assert site.identity is SiteId.REMOTE
    assert isinstance(controller, RemoteController)
    assert controller.sub_task_ramp_s == session.engagement.sub_task_ramp_s
    assert controller.regularisation == session.remote.null_space.regularisation
    assert isinstance(controller.sub_task, NormLimiter)
    assert controller.sub_task.ceiling_rad_s == session.remote.null_space.rate_limit_rad_s
    assert tuple(controller.damping.joint) == session.remote.damping.joint_nm_s
    walls = site._device._contact
    assert isinstance(walls, Walls)
    assert len(walls.walls) == len(session.remote.environment.walls)
