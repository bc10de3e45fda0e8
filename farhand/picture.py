"""What a session's dashboard shows."""

from threading import Lock

import numpy as np
import numpy.typing as npt

from site_runtime.guard import Cut
from site_runtime.keys import SiteId
from site_runtime.parts import coupling_of, robot_of
from site_runtime.session import Session
from site_runtime.supervisor import State
from telemetry.picture import (
    LOCAL_COLOUR,
    REMOTE_COLOUR,
    Colour,
    ObstacleView,
    Picture,
    Scene,
    SiteView,
    WallView,
)

FloatArray = npt.NDArray[np.float64]


def picture_of(session: Session) -> Picture:
    """Both arms, the obstacles and the walls of a session."""
    scene = Scene(
        tuple(
            ObstacleView(
                item.name, _in_space(item.center_m), item.collision_radius_m, item.safe_radius_m
            )
            for item in session.remote.obstacles
        ),
        tuple(
            WallView(_in_space(wall.point_m), _in_space(wall.normal))
            for wall in session.remote.environment.walls
        ),
    )
    return Picture(
        (
            _site_view(session, SiteId.LOCAL, LOCAL_COLOUR),
            _site_view(session, SiteId.REMOTE, REMOTE_COLOUR),
        ),
        scene,
        state_names={state.value: state.name for state in State},
        cut_names={cut.value: cut.name.lower() for cut in Cut if cut.name},
        full_scale_force_n=float(coupling_of(session.coupling).force_ceiling.max()),
    )


def _site_view(session: Session, site: SiteId, colour: Colour) -> SiteView:
    robot = robot_of(session, site)
    alone = Lock()  # a robot model has one workspace, and every sink has a thread

    def chain(q_rows: FloatArray) -> FloatArray:
        with alone:
            return robot.chain_rows(q_rows)

    return SiteView(site.label, colour, chain, robot.joints, robot.task_dimension)


def _in_space(vector: tuple[float, ...]) -> tuple[float, float, float]:
    """Lift a planar vector into space, at z = 0."""
    x, y, z = (*vector, 0.0)[:3]
    return (x, y, z)
