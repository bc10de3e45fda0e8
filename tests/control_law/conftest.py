"""Hardware-free revolute chains of point masses, written from first principles."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pytest

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True)
class ChainTerms:
    q: FloatArray
    q_dot: FloatArray
    X: FloatArray
    X_dot: FloatArray
    J: FloatArray
    J_dot: FloatArray
    J_xyz: FloatArray
    J_xyz_dot: FloatArray
    M: FloatArray
    C: FloatArray
    G: FloatArray
    origins: FloatArray
    origins_dot: FloatArray
    axes: FloatArray
    axes_dot: FloatArray


def _skew(a: FloatArray) -> FloatArray:
    return np.array([[0.0, -a[2], a[1]], [a[2], 0.0, -a[0]], [-a[1], a[0], 0.0]])


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return a×b along the last axis; np.cross is too slow for whole simulations."""
    left, right = [1, 2, 0], [2, 0, 1]
    return a[..., left] * b[..., right] - a[..., right] * b[..., left]


class Chain:
    """Joint axes in the frame of the link before, links along each link's x, masses at tips."""

    def __init__(
        self, lengths: list[float], axes: list[list[float]], z: int, mass: float = 0.3
    ) -> None:
        self.z, self.mass, self.joints = z, mass, len(lengths)
        self.lengths, self.local_axes = np.array(lengths), np.array(axes)
        self.reach_m = self.lengths[::-1].cumsum()[::-1].copy()
        self.gravity = np.array([0.0, -9.81, 0.0])
        self._skew = np.array([_skew(axis) for axis in self.local_axes])
        self._skew2 = self._skew @ self._skew
        # Joint k moves mass i when k ≤ i.
        self._moves = np.tri(self.joints)[:, :, None]

    def terms(self, q: FloatArray, q_dot: FloatArray) -> ChainTerms:
        n, z = self.joints, self.z
        sine, cosine = np.sin(q)[:, None, None], np.cos(q)[:, None, None]
        turns = np.eye(3) + sine * self._skew + (1.0 - cosine) * self._skew2
        rotation, axes, links = np.eye(3), np.zeros((n, 3)), np.zeros((n, 3))
        for i in range(n):
            axes[i] = rotation @ self.local_axes[i]
            rotation = rotation @ turns[i]
            links[i] = self.lengths[i] * rotation[:, 0]
        spins = (axes * q_dot[:, None]).cumsum(0)
        axes_dot = _cross(spins, axes)
        origins, origins_dot = np.zeros((n + 1, 3)), np.zeros((n + 1, 3))
        origins[1:], origins_dot[1:] = links.cumsum(0), _cross(spins, links).cumsum(0)
        # Jacobians of every mass, (mass, joint, 3).
        arm = origins[1:, None] - origins[None, :-1]
        arm_dot = origins_dot[1:, None] - origins_dot[None, :-1]
        J = self._moves * _cross(axes[None], arm)
        J_dot = self._moves * (_cross(axes_dot[None], arm) + _cross(axes[None], arm_dot))
        rows = J.transpose(1, 0, 2).reshape(n, -1)
        M = self.mass * rows @ rows.T
        # For point masses these are the Christoffel symbols of the first kind.
        C = self.mass * rows @ J_dot.transpose(1, 0, 2).reshape(n, -1).T
        G = -self.mass * (J @ self.gravity).sum(0)
        return ChainTerms(
            q, q_dot, origins[-1, :z], origins_dot[-1, :z], J[-1].T[:z], J_dot[-1].T[:z],
            J[-1].T, J_dot[-1].T, M, C, G, origins, origins_dot, axes, axes_dot,
        )  # fmt: skip


def planar(joints: int, length: float = 0.38) -> Chain:
    return Chain([length] * joints, [[0.0, 0.0, 1.0]] * joints, z=2)


def spatial() -> Chain:
    axes = [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [0.0, 0.6, 0.8], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    return Chain([0.1, 0.4, 0.3, 0.25, 0.2], axes, z=3)


@dataclass(frozen=True)
class Motion:
    """q(t) = q₀ + A sin(ωt + φ), joint by joint."""

    start: FloatArray
    amplitude: FloatArray
    frequency: FloatArray
    phase: FloatArray

    def __call__(self, t: float) -> tuple[FloatArray, FloatArray]:
        angle = self.frequency * t + self.phase
        return (
            self.start + self.amplitude * np.sin(angle),
            self.amplitude * self.frequency * np.cos(angle),
        )

    @classmethod
    def random(cls, seed: int, joints: int) -> "Motion":
        rng = np.random.default_rng(seed)
        return cls(
            rng.uniform(-2.0, 2.0, joints),
            rng.uniform(0.2, 0.8, joints),
            rng.uniform(0.5, 3.0, joints),
            rng.uniform(0.0, 6.0, joints),
        )


@pytest.fixture(params=["3R", "4R", "spatial 5R"])
def redundant(request: pytest.FixtureRequest) -> Chain:
    return {"3R": planar(3), "4R": planar(4, 0.25), "spatial 5R": spatial()}[request.param]


@pytest.fixture
def planar_chain() -> Callable[..., Chain]:
    return planar


@pytest.fixture
def random_motion() -> Callable[[int, int], Motion]:
    return Motion.random


@pytest.fixture
def motion() -> type[Motion]:
    return Motion


@pytest.fixture
def gradient() -> Callable[[Callable[[FloatArray], float], FloatArray], FloatArray]:
    def central(f: Callable[[FloatArray], float], q: FloatArray, h: float = 1e-6) -> FloatArray:
        steps = h * np.eye(len(q))
        return np.array([(f(q + step) - f(q - step)) / (2.0 * h) for step in steps])

    return central
