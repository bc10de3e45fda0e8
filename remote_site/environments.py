"""What a simulated remote robot may touch: walls that push back."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hardware.interface import ContactForce
from site_runtime.session import EnvironmentSettings, WallSettings

FloatArray = npt.NDArray[np.float64]


def build_environment(settings: EnvironmentSettings, dimension: int) -> ContactForce | None:
    """Build the environment that a session file describes; None is free space."""
    if not settings.walls:
        return None
    return Walls(tuple(Wall.of(wall) for wall in settings.walls), dimension)


@dataclass(frozen=True, slots=True)
class Wall:
    """A plane with a unit normal into the free space, a stiffness and a damping."""

    point_m: FloatArray
    normal: FloatArray
    stiffness_n_per_m: float
    damping_n_s_per_m: float

    @classmethod
    def of(cls, settings: WallSettings) -> "Wall":
        """Build from the session file's table."""
        normal = np.array(settings.normal)
        return cls(
            np.array(settings.point_m),
            normal / np.linalg.norm(normal),
            settings.stiffness_n_per_m,
            settings.damping_n_s_per_m,
        )

    def push_n(self, position_m: FloatArray, velocity_m_s: FloatArray) -> float:
        """Return the force along the normal [N]: never negative, a wall does not pull."""
        depth_m = float((self.point_m - position_m) @ self.normal)
        if depth_m <= 0.0:
            return 0.0
        speed_m_s = float(velocity_m_s @ self.normal)
        return max(0.0, self.stiffness_n_per_m * depth_m - self.damping_n_s_per_m * speed_m_s)


@dataclass(frozen=True, slots=True)
class Walls:
    """The sum of its walls' forces; passive, as Assumption 1 wants."""

    walls: tuple[Wall, ...]
    dimension: int

    def force_n(
        self, time_s: float, position_m: FloatArray, velocity_m_s: FloatArray
    ) -> FloatArray:
        """Return the force (z,) [N] on the end effector."""
        force = np.zeros(self.dimension)
        for wall in self.walls:
            push_n = wall.push_n(position_m, velocity_m_s)
            if push_n > 0.0:
                force += push_n * wall.normal
        return force
