"""The remote site of a session."""

from remote_site.controller import RemoteController
from remote_site.environments import build_environment
from remote_site.sub_tasks import build_sub_task
from site_runtime.assembly import Surroundings, assemble
from site_runtime.keys import SiteId
from site_runtime.parts import coupling_of, damping_of, robot_of
from site_runtime.session import Session
from site_runtime.site import Site


def build_remote_controller(session: Session) -> RemoteController:
    """Build the remote robot's law."""
    return RemoteController(
        coupling=coupling_of(session.coupling),
        damping=damping_of(session.remote.damping),
        sub_task=build_sub_task(session.remote, robot_of(session, SiteId.REMOTE)),
        sub_task_ramp_s=session.engagement.sub_task_ramp_s,
        regularisation=session.remote.null_space.regularisation,
    )


def build_remote_site(session: Session, surroundings: Surroundings) -> Site:
    """Build the far side."""
    return assemble(
        session,
        SiteId.REMOTE,
        surroundings,
        build_remote_controller(session),
        build_environment(session.remote.environment, session.task.dimension),
    )
