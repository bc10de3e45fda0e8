"""What a session's dashboard shows."""

from collections.abc import Callable
from threading import Lock

import numpy as np
import numpy.typing as npt

from hardware.robot_model import RobotModel, RobotTerms, UrdfArm
from remote_site.site import build_remote_controller
from site_runtime.certification import certify
from site_runtime.derived import derivation
from site_runtime.energy_meter import SessionEnergyMeter, energy_meter
from site_runtime.guard import Cut
from site_runtime.keys import SiteId
from site_runtime.parts import coupling_of, robot_of
from site_runtime.session import Session
from site_runtime.supervisor import State
from telemetry.picture import (
    LOCAL_COLOUR,
    REMOTE_COLOUR,
    CertificateView,
    Colour,
    ObstacleView,
    Picture,
    Scene,
    SiteView,
    UrdfView,
    WallView,
)

FloatArray = npt.NDArray[np.float64]


def picture_of(session: Session) -> Picture:
    """Both arms, the obstacles and the walls of a session, its certificate and its energy."""
    proven = certify(session).best
    engagement = session.engagement
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
        certificate=CertificateView(
            proven.theorem,
            proven.round_trip_s,
            None if engagement.alignment == "none" else engagement.align_within_m,
        ),
        meter=lambda: _meter(session),
    )


def _meter(session: Session) -> SessionEnergyMeter:
    if not session.remote.sub_tasks:
        return energy_meter(session, None)
    controller = build_remote_controller(session)

    def reference(terms: RobotTerms, engaged_s: float) -> FloatArray:
        return controller.reference(terms, engaged_s)[0]

    return energy_meter(session, reference)


def _site_view(session: Session, site: SiteId, colour: Colour) -> SiteView:
    robot = robot_of(session, site)
    alone = Lock()  # a robot model has one workspace, and every sink has a thread

    def chain(q_rows: FloatArray) -> FloatArray:
        with alone:
            return robot.chain_rows(q_rows)

    return SiteView(
        site.label,
        colour,
        chain,
        robot.joints,
        robot.task_dimension,
        _urdf(session, site, robot),
        _clearance(session, site),
    )


def _clearance(session: Session, site: SiteId) -> Callable[[FloatArray], FloatArray] | None:
    if site is SiteId.LOCAL or not session.remote.obstacles:
        return None
    derive = derivation(session)
    return lambda q: derive(site.label, q)["link_distance_m"]


def _urdf(session: Session, site: SiteId, robot: RobotModel) -> UrdfView | None:
    description = session.site(site).robot
    if not isinstance(description, UrdfArm) or robot.task_dimension != 3:
        return None
    return UrdfView(session.path.parent / description.path, robot.joint_names)


def _in_space(vector: tuple[float, ...]) -> tuple[float, float, float]:
    """Lift a planar vector into space, at z = 0."""
    x, y, z = (*vector, 0.0)[:3]
    return (x, y, z)
