"""The paper's session straight on numpy and MuJoCo, as one would write it for this session alone.

A yardstick for `farhand simulate`: of farhand it shares only the session file. It takes sessions
of two planar arms of point masses without gravity, the paper's coupling, joint damping, sinusoidal
delays by timestamp, force pulses of a hand, and one linear sub-task by the plain projector.
"""

import argparse
import math
import tomllib
from pathlib import Path
from typing import Any

import mujoco  # type: ignore[import-untyped]
import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
Table = dict[str, Any]


class Arm:
    """One planar arm in MuJoCo, with its samples: a row a tick."""

    def __init__(self, table: Table, period_s: float, ticks: int) -> None:
        robot = table["robot"]
        if robot["kind"] != "planar" or robot["mass"] != "point" or "gravity_m_s2" in robot:
            raise ValueError(f"{robot} is not a planar arm of point masses without gravity")
        self.model = mujoco.MjModel.from_xml_string(_mjcf(robot["lengths_m"], robot["masses_kg"]))
        disable = mujoco.mjtDisableBit
        self.model.opt.disableflags |= disable.mjDSBL_CONSTRAINT | disable.mjDSBL_EULERDAMP
        self.model.opt.timestep = period_s
        self.data = mujoco.MjData(self.model)
        self.data.qpos[:] = table["device"]["initial_position_rad"]
        self.joint_damping = np.array(table["damping"]["joint_nm_s"])
        self.tip = self.model.body("tip").id
        self.X: FloatArray = self.data.xpos[self.tip, :2]  # a view
        self.J_3d = np.zeros((3, self.model.nv))
        self.J = self.J_3d[:2]
        mujoco.mj_forward(self.model, self.data)
        self.X_start: FloatArray = self.X.copy()
        self.X_samples: FloatArray = np.empty((ticks, 2))
        self.q_samples = np.empty((ticks, self.model.nv))
        self.q_dot_samples = np.empty((ticks, self.model.nv))
        self.torque_samples = np.empty((ticks, self.model.nv))

    def begin_step(self, tick: int) -> None:
        """Bring positions and Jacobian up to date."""
        mujoco.mj_step1(self.model, self.data)
        mujoco.mj_jacBody(self.model, self.data, self.J_3d, None, self.tip)
        self.X_samples[tick] = self.X
        self.q_samples[tick] = self.data.qpos
        self.q_dot_samples[tick] = self.data.qvel

    def end_step(self, tick: int, torque: FloatArray, force: FloatArray | None) -> None:
        """Move on by one period."""
        self.torque_samples[tick] = torque
        self.data.qfrc_applied[:] = torque if force is None else torque + self.J.T @ force
        mujoco.mj_step2(self.model, self.data)

    def seen(self, tick: int, newest: int) -> FloatArray:
        """Return where it was at a tick as the peer sees it, who has samples up to `newest`."""
        tick = min(tick, newest)
        return self.X_start if tick < 0 else self.X_samples[tick]


class SelfMotion:
    """ζ and ζ̇ of g = −κ(aᵀq)a in the null space, and the torque that follows them."""

    def __init__(self, arm: Arm, gain: float, direction: list[float]) -> None:
        self.arm = arm
        self.gain = gain
        self.a = np.array(direction)
        n = arm.model.nv
        self.J_dot_3d, self.M, self.M_out = np.zeros((3, n)), np.zeros((n, n)), np.zeros(n)
        self.bias_sum, self.bias_zeta = np.zeros(n), np.zeros(n)

    def torque(self) -> tuple[FloatArray, FloatArray]:
        """Return Mζ̇ + Cζ and ζ."""
        model, data, J = self.arm.model, self.arm.data, self.arm.J
        mujoco.mj_jacDot(model, data, self.J_dot_3d, None, data.xpos[self.arm.tip], self.arm.tip)
        J_dot = self.J_dot_3d[:2]
        g = (-self.gain * (self.a @ data.qpos)) * self.a
        g_dot = (-self.gain * (self.a @ data.qvel)) * self.a
        gram_inverse = np.linalg.inv(J @ J.T)
        inverse = J.T @ gram_inverse  # J⁺
        projector = np.eye(model.nv) - inverse @ J
        inverse_dot = projector @ J_dot.T @ gram_inverse - inverse @ J_dot @ inverse
        zeta = projector @ g
        zeta_dot = projector @ g_dot - (inverse_dot @ J + inverse @ J_dot) @ g
        mujoco.mj_fullM(model, data, self.M)
        return self.M @ zeta_dot + self._coriolis(zeta), zeta

    def _coriolis(self, zeta: FloatArray) -> FloatArray:
        """Return C(q, q̇)ζ: C is symmetric in the two velocities, and MuJoCo tells h(v) = C(q, v)v.

        C(q, q̇)ζ = ½ (h(q̇ + ζ) − h(q̇) − h(ζ))
        """
        model, data = self.arm.model, self.arm.data
        velocity = data.qvel.copy()
        for v, bias in ((velocity + zeta, self.bias_sum), (zeta, self.bias_zeta)):
            data.qvel[:] = v
            mujoco.mj_comVel(model, data)
            mujoco.mj_rne(model, data, 0, bias)
        data.qvel[:] = velocity
        mujoco.mj_comVel(model, data)
        coriolis: FloatArray = 0.5 * (self.bias_sum - data.qfrc_bias - self.bias_zeta)
        return coriolis


def run(session: Table, duration_s: float) -> tuple[Arm, Arm]:
    """Simulate to `duration_s`; return the local and the remote arm with their samples."""
    rate_hz = session["loop"]["rate_hz"]
    period_ns = round(1e9 / rate_hz)
    ticks = round(duration_s * rate_hz) + 1
    local, remote = (Arm(session[site], 1.0 / rate_hz, ticks) for site in ("local", "remote"))
    omega, b = (np.array(session["coupling"][name]) for name in ("omega", "b"))
    stiffness = omega * b
    to_remote, to_local = (
        session["channel"][direction]["delay"]
        for direction in ("local_to_remote", "remote_to_local")
    )
    pulses = session["local"]["operator"].get("pulses", ())
    sub_tasks = session["remote"].get("sub_tasks", ())
    self_motion = None
    if sub_tasks:
        (task,) = sub_tasks
        self_motion = SelfMotion(remote, task["gain"], task["direction"])

    for tick in range(ticks):
        time_ns = tick * period_ns
        time_s = time_ns * 1e-9

        local.begin_step(tick)
        peer = remote.seen((time_ns - _delay_ns(to_local, time_s)) // period_ns, tick - 1)
        force = stiffness * np.arctan(local.X - peer)
        torque = -(local.J.T @ force) - local.joint_damping * local.data.qvel
        local.end_step(tick, torque, _push(pulses, time_s) if pulses else None)

        remote.begin_step(tick)
        peer = local.seen((time_ns - _delay_ns(to_remote, time_s)) // period_ns, tick)
        force = stiffness * np.arctan(remote.X - peer)
        if self_motion is None:
            torque = -(remote.J.T @ force) - remote.joint_damping * remote.data.qvel
        else:
            own, zeta = self_motion.torque()
            s = remote.data.qvel - zeta
            torque = own - remote.J.T @ force - remote.joint_damping * s
        remote.end_step(tick, torque, None)
    return local, remote


def _delay_ns(delay: Table, time_s: float) -> int:
    delay_s: float = delay["mean_s"] + delay["amplitude_s"] * math.sin(time_s)
    return round(max(0.0, delay_s) * 1e9)


def _push(pulses: list[Table], time_s: float) -> FloatArray:
    force = np.zeros(2)
    for pulse in pulses:
        start_s, end_s = pulse["start_s"], pulse["end_s"]
        if start_s < time_s < end_s:
            phase = (time_s - start_s) / (end_s - start_s)
            force["xy".index(pulse["axis"])] += pulse["force_n"] * math.sin(math.pi * phase) ** 2
    return force


def _mjcf(lengths_m: list[float], masses_kg: list[float]) -> str:
    inner = f'<body name="tip" pos="{lengths_m[-1]!r} 0 0"/>'
    starts_m = [0.0, *lengths_m[:-1]]
    for length_m, mass_kg, start_m in reversed(
        list(zip(lengths_m, masses_kg, starts_m, strict=True))
    ):
        # MuJoCo wants some inertia of a point too; this is the least it takes.
        place = f'pos="{length_m!r} 0 0" diaginertia="2e-15 2e-15 2e-15"'
        inertial = f'<inertial mass="{mass_kg!r}" {place}/>'
        inner = f'<body pos="{start_m!r} 0 0"><joint axis="0 0 1"/>{inertial}{inner}</body>'
    return f'<mujoco><option gravity="0 0 0"/><worldbody>{inner}</worldbody></mujoco>'


def main() -> None:
    """Simulate a session file, as `farhand simulate` does."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("session", type=Path)
    parser.add_argument("--duration", type=float, default=60.0, metavar="SECONDS")
    arguments = parser.parse_args()
    run(tomllib.loads(arguments.session.read_text(encoding="utf-8")), arguments.duration)


if __name__ == "__main__":
    main()
