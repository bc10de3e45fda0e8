"""Kinematics and dynamics of a serial revolute arm; the only module that imports pinocchio."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pinocchio as pin

from hardware.interface import DeviceConfigurationError, FloatArray, nearest_names


@dataclass(frozen=True, slots=True)
class PlanarArm:
    """An arm in the x–y plane, all joints about z, the end effector at the last link's tip.

    `mass` places each link's mass: a point at the link's tip, or a uniform thin rod. Gravity is
    (x, y) [m/s²]; the task is the position (x, y).
    """

    kind: Literal["planar"]
    lengths_m: tuple[float, ...]
    masses_kg: tuple[float, ...]
    mass: Literal["point", "rod"] = "point"
    gravity_m_s2: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        if not self.lengths_m or len(self.lengths_m) != len(self.masses_kg):
            raise DeviceConfigurationError(
                f"a planar arm has one length and one mass a link: lengths_m has "
                f"{len(self.lengths_m)}, masses_kg has {len(self.masses_kg)}"
            )
        for name, values in (("lengths_m", self.lengths_m), ("masses_kg", self.masses_kg)):
            for link, value in enumerate(values, start=1):
                if not 0.0 < value < math.inf:
                    raise DeviceConfigurationError(
                        f"{name} of link {link} is {value}; it must be positive"
                    )
        if not all(math.isfinite(value) for value in self.gravity_m_s2):
            raise DeviceConfigurationError(f"gravity_m_s2 is {self.gravity_m_s2}; must be finite")


@dataclass(frozen=True, slots=True)
class UrdfArm:
    """The revolute chain from the base of a URDF file to one of its frames.

    Joints off the chain are locked at zero and their bodies' inertia kept. Joint friction and
    damping in the file are ignored. `path` is relative to the session file; gravity is in base
    axes [m/s²]; the task is the frame's position, its first `task_dimension` axes.
    """

    kind: Literal["urdf"]
    path: str
    end_effector_frame: str
    gravity_m_s2: tuple[float, float, float] = (0.0, 0.0, -9.81)
    task_dimension: Literal[2, 3] = 3

    def __post_init__(self) -> None:
        if not all(math.isfinite(value) for value in self.gravity_m_s2):
            raise DeviceConfigurationError(f"gravity_m_s2 is {self.gravity_m_s2}; must be finite")


RobotDescription = PlanarArm | UrdfArm


@dataclass(slots=True, eq=False)  # frozen, it would take three times as long to make
class RobotTerms:
    """Everything one tick needs at (q, q̇), n joints, z task axes, SI, base axes.

    M q̈ + C q̇ + G = τ + JᵀF (paper eq. 1); C is built from Christoffel symbols, so Ṁ − 2C is
    skew (Property 2). `origins` holds the joint centres and, last, the end effector; `axes` the
    unit joint axes. The arrays are the caller's to keep.
    """

    q: FloatArray  # (n,)
    q_dot: FloatArray  # (n,)
    X: FloatArray  # (z,)
    X_dot: FloatArray  # (z,)
    J: FloatArray  # (z, n)
    J_dot: FloatArray  # (z, n)
    J_xyz: FloatArray  # (3, n): J, and the axes that the task ignores
    J_xyz_dot: FloatArray  # (3, n)
    M: FloatArray  # (n, n)
    C: FloatArray  # (n, n)
    G: FloatArray  # (n,)
    origins: FloatArray  # (n + 1, 3)
    axes: FloatArray  # (n, 3)
    axes_dot: FloatArray  # (n, 3)
    _origins_dot: FloatArray | None = None

    @property
    def origins_dot(self) -> FloatArray:
        """Velocities of the `origins`, (n + 1, 3); worked out when first asked for."""
        if self._origins_dot is None:
            self._origins_dot = _origins_dot(self.origins, self.axes, self.q_dot)
        return self._origins_dot


class RobotModel:
    """A serial arm of revolute joints, and its end effector.

    Not thread-safe: results pass through one workspace; give each thread its own model.
    """

    def __init__(self, model: pin.Model, frame: int, task_dimension: int) -> None:
        self._model = model
        self._frame = frame
        self._data = data = model.createData()
        n = model.nv
        # pinocchio writes into the same memory at every call, so these views are made once.
        # Everywhere, reshape undoes its habit of handing out a matrix of one column as a vector.
        self._M, self._C, self._G = data.M.reshape(n, n), data.C.reshape(n, n), data.g
        self._axes, self._axes_dot = data.J.reshape(6, n)[3:].T, data.dJ.reshape(6, n)[3:].T
        self._points = [placement.translation for placement in list(data.oMi)[1:]]
        self._points.append(data.oMf[frame].translation)
        self.joints: int = n
        self.joint_names: tuple[str, ...] = tuple(model.names)[1:]
        self.task_dimension: int = task_dimension
        self.position_limits_rad: tuple[FloatArray, FloatArray] = (
            model.lowerPositionLimit.copy(),
            model.upperPositionLimit.copy(),
        )
        links = np.linalg.norm(np.diff(self.chain(np.zeros(self.joints)), axis=0), axis=1)
        # Upper bound, over all poses, of the distance of the end effector from each joint
        # centre (n,) [m]: the links from there on, stretched.
        self.reach_m: FloatArray = np.cumsum(links[::-1])[::-1].copy()

    def terms(self, q: FloatArray, q_dot: FloatArray) -> RobotTerms:
        """Return everything a tick needs at joint positions q (n,) and velocities q̇ (n,)."""
        z, n = self.task_dimension, self.joints
        J, J_dot = self.compute(q, q_dot)
        J, J_dot = J.reshape(6, n), J_dot.reshape(6, n)
        origins = np.array(self._points)
        task = J[:z]
        return RobotTerms(
            q.copy(),
            q_dot.copy(),
            origins[-1, :z],
            task.dot(q_dot),
            task,
            J_dot[:z],
            J[:3],
            J_dot[:3],
            self._M.copy(),
            self._C.copy(),
            self._G.copy(),
            origins,
            self._axes.copy(),
            self._axes_dot.copy(),
        )

    def compute(self, q: FloatArray, q_dot: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Let pinocchio work out all that `terms` reads; return the frame's J and J̇, (6, n)."""
        model, data, frame = self._model, self._data, self._frame
        pin.crba(model, data, q)
        pin.computeGeneralizedGravity(model, data, q)
        pin.computeCoriolisMatrix(model, data, q, q_dot)  # last: leaves placements, J and J̇
        pin.updateFramePlacement(model, data, frame)
        return (
            pin.getFrameJacobian(model, data, frame, pin.LOCAL_WORLD_ALIGNED),
            pin.getFrameJacobianTimeVariation(model, data, frame, pin.LOCAL_WORLD_ALIGNED),
        )

    def end_effector(
        self, q: FloatArray, q_dot: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return X (z,), Ẋ (z,) and J (z, n) alone."""
        model, data, z = self._model, self._data, self.task_dimension
        J = pin.computeFrameJacobian(model, data, q, self._frame, pin.LOCAL_WORLD_ALIGNED)
        J = J.reshape(6, -1)[:z]
        return self._points[-1][:z].copy(), J.dot(q_dot), J

    def forward_dynamics(
        self, q: FloatArray, q_dot: FloatArray, torque: FloatArray, force: FloatArray | None = None
    ) -> FloatArray:
        """Return q̈ (n,) of M q̈ + C q̇ + G = τ + JᵀF, torque (n,) and end-effector force (z,)."""
        if force is not None:
            J = self.end_effector(q, q_dot)[2]
            torque = torque + J.T @ force
        acceleration: FloatArray = pin.aba(self._model, self._data, q, q_dot, torque)
        return acceleration

    def inverse_inertia(self, q: FloatArray) -> FloatArray:
        """Return M⁻¹ (n, n)."""
        inverse: FloatArray = pin.computeMinverse(self._model, self._data, q)
        return inverse.reshape(self.joints, self.joints)

    def orientation(self, q: FloatArray) -> FloatArray:
        """Return R (3, 3) of the end effector's frame: v in base axes = R v in the frame's.

        A planar arm's frame has x along the last link and z along the joint axes.
        """
        pin.forwardKinematics(self._model, self._data, q)
        rotation: FloatArray = pin.updateFramePlacement(
            self._model, self._data, self._frame
        ).rotation
        return rotation.copy()

    def chain(self, q: FloatArray) -> FloatArray:
        """Return the joint centres and the end effector (n + 1, 3) [m], for drawing."""
        pin.forwardKinematics(self._model, self._data, q)
        pin.updateFramePlacement(self._model, self._data, self._frame)
        return np.array(self._points)

    def chain_rows(self, q_rows: FloatArray) -> FloatArray:
        """Return `chain` of every row: (r, n) → (r, n + 1, 3)."""
        chains = np.empty((len(q_rows), self.joints + 1, 3))
        for row, q in enumerate(q_rows):
            chains[row] = self.chain(q)
        return chains


def build_robot(description: RobotDescription, base_dir: Path | None) -> RobotModel:
    """Build the model of a description; `base_dir` is where a relative URDF path starts.

    Raises DeviceConfigurationError when the file, the frame or a joint cannot be used.
    """
    if isinstance(description, PlanarArm):
        return _build_planar(description)
    return _build_urdf(description, base_dir)


def _origins_dot(origins: FloatArray, axes: FloatArray, q_dot: FloatArray) -> FloatArray:
    """ȯ₁ = 0, ȯ_{i+1} = ȯ_i + ω_i × (o_{i+1} − o_i)."""
    velocities = [(0.0, 0.0, 0.0)]
    vx = vy = vz = wx = wy = wz = 0.0
    points = origins.tolist()
    x, y, z = points[0]
    # Scalars: for a handful of joints this is several times faster than array cross products.
    for (ax, ay, az), rate, (x_next, y_next, z_next) in zip(
        axes.tolist(), q_dot.tolist(), points[1:], strict=True
    ):
        wx, wy, wz = wx + rate * ax, wy + rate * ay, wz + rate * az
        dx, dy, dz = x_next - x, y_next - y, z_next - z
        vx, vy, vz = vx + wy * dz - wz * dy, vy + wz * dx - wx * dz, vz + wx * dy - wy * dx
        velocities.append((vx, vy, vz))
        x, y, z = x_next, y_next, z_next
    return np.array(velocities)


def _build_planar(arm: PlanarArm) -> RobotModel:
    model = pin.Model()
    model.gravity = pin.Motion(np.array([*arm.gravity_m_s2, 0.0]), np.zeros(3))
    joint, start_m = 0, 0.0
    for link, (length_m, mass_kg) in enumerate(
        zip(arm.lengths_m, arm.masses_kg, strict=True), start=1
    ):
        joint = _add_revolute(
            model,
            joint,
            _translation(start_m),
            np.array([0.0, 0.0, 1.0]),
            f"joint_{link}",
            (-math.inf, math.inf),
        )
        if arm.mass == "point":
            inertia = pin.Inertia(mass_kg, np.array([length_m, 0.0, 0.0]), np.zeros((3, 3)))
        else:
            about_centre = mass_kg * length_m**2 / 12.0
            inertia = pin.Inertia(
                mass_kg,
                np.array([length_m / 2.0, 0.0, 0.0]),
                np.diag([0.0, about_centre, about_centre]),
            )
        model.appendBodyToJoint(joint, inertia, pin.SE3.Identity())
        start_m = length_m
    frame = model.addFrame(
        pin.Frame("end_effector", joint, _translation(start_m), pin.FrameType.OP_FRAME)
    )
    return RobotModel(model, frame, task_dimension=2)


def _build_urdf(arm: UrdfArm, base_dir: Path | None) -> RobotModel:
    path = (base_dir or Path()) / arm.path
    if not path.is_file():
        raise DeviceConfigurationError(f"there is no URDF file {path}; correct `path`")
    try:
        parsed = pin.buildModelFromUrdf(str(path), mimic=True)
    except (ValueError, RuntimeError) as error:  # RuntimeError: a file that cannot be read
        raise DeviceConfigurationError(f"{path} cannot be read as URDF: {error}") from error
    frame = _frame_id(parsed, arm.end_effector_frame, path)
    chain = list(parsed.supports[parsed.frames[frame].parentJoint])[1:]
    if not chain:
        raise DeviceConfigurationError(
            f"frame {arm.end_effector_frame!r} of {path} does not move: there is no joint between "
            f"it and the base"
        )
    for joint in chain:
        _require_revolute(parsed, joint, path)
    locked = [joint for joint in range(1, parsed.njoints) if joint not in set(chain)]
    reduced = pin.buildReducedModel(parsed, locked, pin.neutral(parsed))
    model = _with_scalar_joints(reduced)
    model.gravity = pin.Motion(np.array(arm.gravity_m_s2), np.zeros(3))
    tip = reduced.frames[_frame_id(reduced, arm.end_effector_frame, path)]
    frame = model.addFrame(pin.Frame(tip.name, tip.parentJoint, tip.placement, tip.type))
    _require_inertia(model, path)
    return RobotModel(model, frame, arm.task_dimension)


def _frame_id(model: pin.Model, name: str, path: Path) -> int:
    # A URDF link and a joint may share a name; the body frame is the link.
    body = model.getFrameId(name, pin.FrameType.BODY)
    if body < model.nframes:
        return int(body)
    for index, frame in enumerate(model.frames):
        if frame.name == name:
            return index
    nearest = nearest_names(name, (frame.name for frame in model.frames))
    raise DeviceConfigurationError(f"{path} has no frame {name!r}; nearest: {nearest}")


def _require_revolute(model: pin.Model, joint: int, path: Path) -> None:
    kind = model.joints[joint].shortname()
    if not kind.startswith("JointModelR"):  # bounded, unbounded, about any axis
        raise DeviceConfigurationError(
            f"joint {model.names[joint]!r} of {path}, between the base and the end effector, is of "
            f"type {kind.removeprefix('JointModel')}; only revolute and continuous joints can be "
            f"controlled (the theory's Property 4)"
        )


def _require_inertia(model: pin.Model, path: Path) -> None:
    M = pin.crba(model, model.createData(), np.zeros(model.nv)).reshape(model.nv, model.nv)
    smallest = float(np.linalg.eigvalsh(M)[0])
    if smallest <= 1e-9:
        raise DeviceConfigurationError(
            f"the inertia matrix of {path} is singular (smallest eigenvalue {smallest:.2g} kg·m²): "
            f"give the links after each joint a mass and an inertia"
        )


def _with_scalar_joints(reduced: pin.Model) -> pin.Model:
    """Copy a serial chain so that a continuous joint too has one coordinate, without limits."""
    model = pin.Model()
    data = reduced.createData()
    neutral = pin.neutral(reduced)
    for joint in range(1, reduced.njoints):
        source = reduced.joints[joint]
        jacobian = pin.computeJointJacobian(reduced, data, neutral, joint)
        axis = jacobian.reshape(6, -1)[3:, source.idx_v]
        if source.nq == 1:
            limits = (
                float(reduced.lowerPositionLimit[source.idx_q]),
                float(reduced.upperPositionLimit[source.idx_q]),
            )
        else:
            limits = (-math.inf, math.inf)
        added = _add_revolute(
            model,
            reduced.parents[joint],
            reduced.jointPlacements[joint],
            axis,
            reduced.names[joint],
            limits,
        )
        model.appendBodyToJoint(added, reduced.inertias[joint], pin.SE3.Identity())
    return model


def _add_revolute(
    model: pin.Model,
    parent: int,
    placement: Any,  # noqa: ANN401  pinocchio has no type information
    axis: FloatArray,
    name: str,
    limits_rad: tuple[float, float],
) -> int:
    aligned = (pin.JointModelRX, pin.JointModelRY, pin.JointModelRZ)
    for unit, kind in zip(np.eye(3), aligned, strict=True):
        if np.array_equal(axis, unit):
            joint_model = kind()
            break
    else:
        joint_model = pin.JointModelRevoluteUnaligned(axis)
    unlimited = np.array([math.inf])
    return int(
        model.addJoint(
            parent,
            joint_model,
            placement,
            name,
            unlimited,
            unlimited,
            np.array([limits_rad[0]]),
            np.array([limits_rad[1]]),
        )
    )


def _translation(x_m: float) -> Any:  # noqa: ANN401  pinocchio has no type information
    return pin.SE3(np.eye(3), np.array([x_m, 0.0, 0.0]))
