"""The energy oracle of control_law.lyapunov along a session of the sites' own code."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from channel.delay import ConstantDelay, DelayModel, SinusoidDelay, UniformDelay
from control_law.lyapunov import LyapunovKrasovskii, SiteMotion
from experiments.simulation import Run, Simulation
from site_runtime.certification import certify
from site_runtime.keys import SiteId
from site_runtime.parts import coupling_of, robot_of
from site_runtime.session import (
    ChannelSettings,
    DampingSettings,
    EngagementSettings,
    Session,
    StiffnessCoupling,
)

DELAY_S = 0.2
STIFFNESS = 50.0
# Theorem B asks for (T/2 + h)K = (0.2 + 0.001)·50 = 10.05, with h for the torque held over a tick:
# what sampling adds to V is paid for, so that the only rise left is the rounding of its running
# sums, a few joule-seconds each: 1e-16 of that, a tick.
DAMPING = 11.0
ROUNDING_J = 1e-14


@pytest.fixture
def free_session(
    make_session: Callable[..., Session], make_channel: Callable[..., ChannelSettings]
) -> Callable[[DelayModel, float], Session]:
    """Free motion from 0.1 m apart, no sub-task and no ramp: V is defined along all of it."""

    def build(delay: DelayModel, share: float) -> Session:
        session = make_session(
            make_channel(delay),
            coupling=StiffnessCoupling("stiffness", (STIFFNESS,) * 2, (8.0,) * 2),
            engagement=EngagementSettings(
                alignment="none", ramp_s=0.0, sub_task_ramp_s=0.0, beyond_certificate="warn"
            ),
        )
        task = (share * DAMPING,) * 2
        device = replace(session.local.device, initial_position_rad=(-0.1, 1.4))
        return replace(
            session,
            local=replace(
                session.local, damping=DampingSettings((0.05 * share,) * 2, task), device=device
            ),
            remote=replace(
                session.remote, damping=DampingSettings((0.05 * share,) * 3, task), sub_tasks=()
            ),
        )

    return build


def energy_j(session: Session, run: Run) -> np.ndarray:
    """V at every tick; s is the joint velocity, there being no sub-task."""
    functional = LyapunovKrasovskii(coupling_of(session.coupling), DELAY_S, DELAY_S)
    robots = [robot_of(session, site) for site in SiteId]
    period_s = session.period_ns * 1e-9
    totals = []
    for rows in zip(run.local, run.remote, strict=True):
        local, remote = (
            SiteMotion(row["q_dot"], robot.terms(row["q"], row["q_dot"]).M, row["velocity_m_s"])
            for robot, row in zip(robots, rows, strict=True)
        )
        error = rows[0]["position_m"] - rows[1]["position_m"]
        totals.append(functional.update(local, remote, error, period_s).total)
    return np.array(totals)


DELAYS = {
    "constant": ConstantDelay(DELAY_S),
    "sinusoid": SinusoidDelay(DELAY_S / 2, DELAY_S / 2, 2.0),
    "jumping every tick": UniformDelay(0.0, DELAY_S),
}


@pytest.mark.parametrize("delay", DELAYS)
def test_the_energy_of_a_certified_free_session_never_rises(
    free_session: Callable[[DelayModel, float], Session], delay: str
) -> None:
    session = free_session(DELAYS[delay], 1.0)
    assert certify(session).margin_s > 0.0
    run = Simulation(session).run(2.5)
    V = energy_j(session, run)
    assert V[-1] < 1e-3 * V[0]
    assert np.diff(V).max() <= ROUNDING_J


def test_at_a_quarter_of_the_damping_it_rises(
    free_session: Callable[[DelayModel, float], Session],
) -> None:
    session = free_session(DELAYS["constant"], 0.25)
    assert certify(session).margin_s < 0.0
    run = Simulation(session).run(2.5)
    V = energy_j(session, run)
    rises = np.diff(V).clip(0.0)
    assert rises.max() > 1e-3 * V[0]
    assert rises.sum() > 10.0 * V[0]
