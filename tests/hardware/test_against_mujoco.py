"""The simulated robots against MuJoCo, another engine with other algorithms: the same numbers.

MuJoCo builds each arm by itself: a planar one from its lengths and masses, the others from their
URDF. Of what it adds by default nothing is left (`_bare`). Three tolerances:

- Terms at a state: `ROUNDING`. Rounding touches 1e-14 of values up to 60 (SI units), and the
  inertia that MuJoCo demands of a point or a thin rod (`_planar_mjcf`) adds up to 2e-14 kg m² to M.
  Measured: 3e-14.
- Paths by the same formula, step by step: `PATH_RAD`. Rounding puts 1e-16 rad a step between the
  engines, and that inertia a few 1e-12 of every acceleration. Joint friction makes the arm forget
  both; without it they grow, some hundredfold in 5 s of gentle motion. Measured: 3e-13, 8e-12.
- Paths by different steps: an error of order p, falling as 2^-p when the step h is halved, is
  |x_h − x_h/2| / (2^p − 1) at h/2, whatever the robot. Measured: within 30 %.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
import pytest

from experiments.simulation import Simulation
from hardware.interface import FloatArray
from hardware.robot_model import PlanarArm, RobotModel, UrdfArm, build_robot
from hardware.simulated import SimulatedDevice, SimulatedSettings
from site_runtime.session import load_session
from telemetry.rows import RowArray

HERE = Path(__file__).parent
EXPERIMENTS = HERE.parents[1] / "experiments"

ROUNDING = 1e-13
PATH_RAD, FRICTIONLESS_PATH_RAD = 1e-11, 1e-9

MS = 1_000_000
HOLD_NS, HOLDS = 100 * MS, 50  # a torque is held for 0.1 s; a path is 5 s


class Pair(NamedTuple):
    """One arm in both engines; `tip` is the end effector among MuJoCo's bodies."""

    ours: RobotModel
    theirs: mujoco.MjModel
    tip: int


def _bare(spec: mujoco.MjSpec, gravity: tuple[float, ...], tip: str) -> tuple[mujoco.MjModel, int]:
    """Compile to rigid bodies and gravity alone, all frames kept.

    Contacts and joint limits are constraints; without them a joint's effort limit, which bounds
    actuators only, is all that a URDF leaves. Euler must take joint damping explicitly, as ours.
    """
    spec.compiler.fusestatic = False  # else the massless tip is merged away
    model = spec.compile()
    model.opt.gravity = gravity
    disable = mujoco.mjtDisableBit
    model.opt.disableflags |= disable.mjDSBL_CONSTRAINT | disable.mjDSBL_EULERDAMP
    return model, model.body(tip).id


def _planar_mjcf(lengths_m: tuple[float, ...], masses_kg: tuple[float, ...], mass: str) -> str:
    """Nested links along x; MuJoCo works out a rod's inertia from its shape.

    It wants inertias above 1e-15 kg m². A point gets 2e-15, a rod a radius of 0.2 µm, which is
    m r²/4 = 1e-14 kg m² for each kg: of the least inertia here, 2e-4 kg m², less than 1e-10.
    """
    inner = f'<body name="tip" pos="{lengths_m[-1]!r} 0 0"/>'
    for length_m, mass_kg, start_m in reversed(
        list(zip(lengths_m, masses_kg, (0.0, *lengths_m), strict=False))
    ):
        if mass == "point":
            place = f'pos="{length_m!r} 0 0" diaginertia="2e-15 2e-15 2e-15"'
            body = f'<inertial mass="{mass_kg!r}" {place}/>'
        else:
            shape = f'type="cylinder" size="2e-7" fromto="0 0 0 {length_m!r} 0 0"'
            body = f'<geom mass="{mass_kg!r}" {shape}/>'
        inner = f'<body pos="{start_m!r} 0 0"><joint axis="0 0 1"/>{body}{inner}</body>'
    return f"<mujoco><worldbody>{inner}</worldbody></mujoco>"


def planar(links: int, mass: str, gravity: tuple[float, float]) -> Pair:
    if links == 4:
        lengths_m, masses_kg = (0.254, 0.1405, 0.21, 0.17), (1.0, 0.7, 0.2, 0.1)
    else:
        lengths_m, masses_kg = (0.38,) * links, (0.3,) * links
    ours = build_robot(PlanarArm("planar", lengths_m, masses_kg, mass, gravity), None)  # type: ignore[arg-type]
    spec = mujoco.MjSpec.from_string(_planar_mjcf(lengths_m, masses_kg, mass))
    return Pair(ours, *_bare(spec, (*gravity, 0.0), "tip"))


def from_urdf(path: Path, tip: str, gravity: tuple[float, float, float]) -> Pair:
    ours = build_robot(UrdfArm("urdf", path.name, tip, gravity), path.parent)
    spec = mujoco.MjSpec.from_file(str(path))
    # Joints off the chain, ours locks: a body without a joint is welded to its parent.
    for element in [*spec.equalities, *(j for j in spec.joints if j.name.startswith("slide_"))]:
        spec.delete(element)
    return Pair(ours, *_bare(spec, gravity, tip))


def seven_joints(gravity: tuple[float, float, float]) -> Pair:
    return from_urdf(EXPERIMENTS / "seven_dof_arm.urdf", "tool_tip", gravity)


WEIGHTLESS, HEAVY = (0.0, 0.0), (3.0, -9.0)
PLANAR: dict[str, Callable[[], Pair]] = {
    f"{links}R {mass}{', heavy' if gravity == HEAVY else ''}": partial(planar, links, mass, gravity)
    for links in (2, 3, 4)
    for mass in ("point", "rod")
    for gravity in (WEIGHTLESS, HEAVY)
}
SPATIAL: dict[str, Callable[[], Pair]] = {
    "seven joints": partial(seven_joints, (0.0, 0.0, -9.81)),
    "seven joints, hanging": partial(seven_joints, (1.0, -2.0, 9.0)),
    "seven joints, weightless": partial(seven_joints, (0.0, 0.0, 0.0)),
    "crooked": partial(from_urdf, HERE / "crooked_arm.urdf", "tool", (0.0, 0.0, -9.81)),
}
ARMS = PLANAR | SPATIAL


# At one state.


@pytest.mark.parametrize("arm", ARMS)
def test_terms_agree(arm: str) -> None:
    ours, model, tip = ARMS[arm]()
    data = mujoco.MjData(model)
    n, z = ours.joints, ours.task_dimension
    M, J = np.zeros((n, n)), np.zeros((3, n))
    random = np.random.default_rng(20)
    for _ in range(20):
        data.qpos[:] = random.uniform(-np.pi, np.pi, n)
        data.qvel[:] = random.uniform(-2.0, 2.0, n)
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, M)
        mujoco.mj_jacBody(model, data, J, None, tip)
        terms = ours.terms(data.qpos, data.qvel)
        bias = terms.C @ data.qvel + terms.G  # MuJoCo's gravity too stands on the left of (1)
        np.testing.assert_allclose(terms.M, M, 0.0, ROUNDING)
        np.testing.assert_allclose(bias, data.qfrc_bias, 0.0, ROUNDING)
        np.testing.assert_allclose(terms.X, data.xpos[tip, :z], 0.0, ROUNDING)
        np.testing.assert_allclose(terms.J, J[:z], 0.0, ROUNDING)


@pytest.mark.parametrize("arm", ARMS)
def test_accelerations_agree(arm: str) -> None:
    ours, model, tip = ARMS[arm]()
    data = mujoco.MjData(model)
    n, z = ours.joints, ours.task_dimension
    random = np.random.default_rng(21)
    for _ in range(20):
        data.qpos[:] = random.uniform(-np.pi, np.pi, n)
        data.qvel[:] = random.uniform(-2.0, 2.0, n)
        torque_nm, force_n = random.uniform(-5.0, 5.0, n), np.zeros(3)
        force_n[:z] = random.uniform(-5.0, 5.0, z)
        mujoco.mj_forward(model, data)  # where the tip is
        data.qfrc_applied[:] = torque_nm
        at = data.xpos[tip]
        mujoco.mj_applyFT(model, data, force_n, np.zeros(3), at, tip, data.qfrc_applied)
        mujoco.mj_forward(model, data)
        acceleration = ours.forward_dynamics(data.qpos, data.qvel, torque_nm, force_n[:z])
        # As torques: what a difference of `ROUNDING` in M and in the bias comes to.
        difference_nm = np.zeros(n)
        mujoco.mj_mulM(model, data, difference_nm, acceleration - data.qacc)
        limit_nm = ROUNDING * (1.0 + np.abs(data.qacc).sum())
        np.testing.assert_allclose(difference_nm, 0.0, atol=limit_nm)


# Over 5 s.


class Swing(NamedTuple):
    """An arm that held torques, drawn anew each 0.1 s around half its weight, keep in motion."""

    arm: str
    torque_nm: float  # standard deviation
    friction_nm_s: float  # viscous, in every joint

    def start_and_torques(self, ours: RobotModel) -> tuple[FloatArray, FloatArray]:
        random = np.random.default_rng(3)
        start_rad = random.uniform(-1.0, 1.0, ours.joints)
        carried = 0.5 * ours.terms(start_rad, np.zeros(ours.joints)).G
        return start_rad, carried + self.torque_nm * random.standard_normal((HOLDS, ours.joints))


def our_path(
    ours: RobotModel,
    start_rad: FloatArray,
    torques_nm: FloatArray,
    step_ns: int,
    **options: object,
) -> FloatArray:
    """Joint angles at the end of every hold, (holds, n) [rad]."""
    now_ns = 0
    settings = SimulatedSettings(tuple(start_rad), step_s=step_ns / 1e9, **options)  # type: ignore[arg-type]
    device = SimulatedDevice(ours, settings, None, lambda: now_ns, 0, seed=0)
    device.open()
    device.enable()
    path = []
    for torque_nm in torques_nm:
        device.write(torque_nm)
        for _ in range(HOLD_NS // step_ns):
            now_ns += step_ns
            state = device.read()
        path.append(state.position_rad)
    return np.array(path)


def mujoco_path(
    model: mujoco.MjModel,
    start_rad: FloatArray,
    torques_nm: FloatArray,
    step_ns: int,
    *,
    hold_ns: int = HOLD_NS,
    integrator: mujoco.mjtIntegrator = mujoco.mjtIntegrator.mjINT_EULER,
    friction_nm_s: float = 0.0,
) -> FloatArray:
    """The same by MuJoCo."""
    model.opt.timestep = step_ns / 1e9
    model.opt.integrator = integrator
    model.dof_damping[:] = friction_nm_s
    data = mujoco.MjData(model)
    data.qpos[:] = start_rad
    path = []
    for torque_nm in torques_nm:
        data.qfrc_applied[:] = torque_nm
        mujoco.mj_step(model, data, nstep=hold_ns // step_ns)
        path.append(data.qpos.copy())
    return np.array(path)


@pytest.mark.parametrize(
    ("swing", "tolerance_rad"),
    [
        *((Swing(arm, 0.3, 0.1), PATH_RAD) for arm in PLANAR),
        # Upright, the seven joints fall over; four links without friction swing chaotically.
        *((Swing(arm, 1.0, 0.3), PATH_RAD) for arm in SPATIAL if arm != "seven joints"),
        *((Swing(arm, 0.03, 0.0), FRICTIONLESS_PATH_RAD) for arm in PLANAR if "4R" not in arm),
    ],
    ids=str,
)
def test_semi_implicit_path_is_mujocos_euler(swing: Swing, tolerance_rad: float) -> None:
    ours, model, _ = ARMS[swing.arm]()
    start, torques = swing.start_and_torques(ours)
    path = our_path(ours, start, torques, MS, viscous_friction_nm_s=swing.friction_nm_s)
    expected = mujoco_path(model, start, torques, MS, friction_nm_s=swing.friction_nm_s)
    assert np.ptp(path, axis=0).min() > 0.1  # every joint moved
    np.testing.assert_allclose(path, expected, 0.0, tolerance_rad)


@pytest.mark.parametrize(
    "swing",
    [
        Swing("2R point, heavy", 0.3, 0.1),
        Swing("4R rod, heavy", 0.3, 0.1),
        Swing("seven joints, hanging", 1.0, 0.3),
    ],
    ids=lambda swing: swing.arm,
)
def test_integrators_converge_to_mujocos_path(swing: Swing) -> None:
    ours, model, _ = ARMS[swing.arm]()
    start, torques = swing.start_and_torques(ours)
    true = mujoco_path(
        model,
        start,
        torques,
        MS // 4,
        integrator=mujoco.mjtIntegrator.mjINT_RK4,
        friction_nm_s=swing.friction_nm_s,
    )
    left_rad = {}
    for integrator, order in (("semi-implicit", 1), ("rk4", 4)):
        coarse, fine = (
            our_path(
                ours,
                start,
                torques,
                step_ns,
                integrator=integrator,
                viscous_friction_nm_s=swing.friction_nm_s,
            )
            for step_ns in (2 * MS, MS)
        )
        before_rad, after_rad = np.abs(coarse - true).max(), np.abs(fine - true).max()
        predicted_rad = np.abs(coarse - fine).max() / (2**order - 1)
        assert np.log2(before_rad / after_rad) == pytest.approx(order, abs=0.5)
        assert after_rad == pytest.approx(predicted_rad, rel=0.4)
        left_rad[integrator] = after_rad
    assert left_rad["rk4"] < 1e-3 * left_rad["semi-implicit"]


# In closed loop.


def test_recorded_torques_move_mujoco_along_the_recorded_paths() -> None:
    run = Simulation(load_session(EXPERIMENTS / "theorems.toml")).run(5.0)
    assert run.failures == ()

    def check(links: int, rows: RowArray) -> None:
        model = PLANAR[f"{links}R point"]().theirs
        path = mujoco_path(model, rows["q"][0], rows["torque_nm"][:-1], MS, hold_ns=MS)
        assert np.ptp(path, axis=0).max() > 0.3
        np.testing.assert_allclose(path, rows["q"][1:], 0.0, PATH_RAD)

    check(2, run.local)
    check(3, run.remote)
