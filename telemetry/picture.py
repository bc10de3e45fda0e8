"""What a dashboard shows, and the geometry of drawing it; no drawing library."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from telemetry.energy import EnergyMeter
from telemetry.rows import TelemetryError

FloatArray = npt.NDArray[np.float64]
Colour = tuple[int, int, int]

LOCAL_COLOUR: Final[Colour] = (255, 176, 59)
REMOTE_COLOUR: Final[Colour] = (77, 171, 247)
RED: Final[Colour] = (255, 107, 107)
WHITE: Final[Colour] = (240, 240, 240)
GREY: Final[Colour] = (128, 128, 128)
BACKGROUND: Final[Colour] = (13, 14, 17)

_MARGIN: Final = 0.3


@dataclass(frozen=True, slots=True)
class UrdfView:
    """Where a robot's body is described, and its joints there, in the order of the rows."""

    path: Path
    joint_names: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class SiteView:
    """One site: its name, colour, joints, task dimensions, and its arm's shape.

    `chain` turns joint angles (r, n) [rad] into the points (r, n + 1, 3) [m] of the arm, from the
    first joint's centre to the end effector; `urdf` is the body around them, if it is to be shown.
    `clearance` tells from the angles how far the arm is from the nearest obstacle (r,) [m].
    """

    name: str
    colour: Colour
    chain: Callable[[FloatArray], FloatArray]
    joints: int
    dimension: int
    urdf: UrdfView | None = None
    clearance: Callable[[FloatArray], FloatArray] | None = None


@dataclass(frozen=True, slots=True)
class CertificateView:
    """What the gains are proven for: by which theorem, up to which round trip [s].

    Points further apart than `align_within_m` keep the sites from engaging; None: never.
    """

    theorem: str
    round_trip_s: float
    align_within_m: float | None = None


@dataclass(frozen=True, slots=True)
class ObstacleView:
    """An obstacle: centre (3,) [m], the radius of a collision and the one to keep away by."""

    name: str
    center_m: tuple[float, float, float]
    collision_radius_m: float
    safe_radius_m: float


@dataclass(frozen=True, slots=True)
class WallView:
    """A wall: a point on it (3,) [m] and its normal (3,), which points into free space."""

    point_m: tuple[float, float, float]
    normal: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Scene:
    """What stands around the arms, in the base axes that both sites share."""

    obstacles: tuple[ObstacleView, ...] = ()
    walls: tuple[WallView, ...] = ()


@dataclass(frozen=True, slots=True)
class Picture:
    """What a dashboard shows: the sites (local, remote), their scene, and the names of numbers.

    `state_names` by supervisor state, `cut_names` by the guard's bit mask. A force of
    `full_scale_force_n` is drawn half as long as the shorter arm. `meter` makes an energy meter at
    its start, one a sink. TelemetryError if the sites do not share their task dimensions.
    """

    sites: tuple[SiteView, SiteView]
    scene: Scene
    state_names: Mapping[int, str]
    cut_names: Mapping[int, str] = field(default_factory=dict)
    full_scale_force_n: float = 10.0
    certificate: CertificateView | None = None
    meter: Callable[[], EnergyMeter] | None = None
    reach_m: float = field(init=False)

    def __post_init__(self) -> None:
        local, remote = self.sites
        if local.dimension != remote.dimension:
            raise TelemetryError(
                f"the {local.name} task has {local.dimension} dimensions and the {remote.name} "
                f"task {remote.dimension}: one picture needs one task space"
            )
        object.__setattr__(self, "reach_m", min(_reach_m(view) for view in self.sites))

    @property
    def spatial(self) -> bool:
        """Whether the arms are drawn in three dimensions."""
        return self.sites[0].dimension == 3

    def place(self, points: FloatArray) -> FloatArray:
        """Keep of points (..., 3) the axes that are drawn."""
        return points if self.spatial else points[..., :2]

    def arrows(self, forces_n: FloatArray) -> FloatArray:
        """Turn forces (r, z) [N] into arrows [m], no longer than the arm whatever the force."""
        vectors = forces_n * (self.reach_m / 2 / self.full_scale_force_n)
        lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
        arrows: FloatArray = vectors * np.minimum(1.0, self.reach_m / np.maximum(lengths, 1e-9))
        return arrows


class Extent:
    """The box that the views of the arms show: it grows when an arm is about to leave it."""

    def __init__(self, picture: Picture) -> None:
        self._margin_m = _MARGIN * picture.reach_m
        corners = [
            home(view) + sign * 0.1 * picture.reach_m for view in picture.sites for sign in (-1, 1)
        ]
        for obstacle in picture.scene.obstacles:
            radius_m = 1.1 * obstacle.safe_radius_m
            corners += [np.array(obstacle.center_m) + sign * radius_m for sign in (-1, 1)]
        self.low, self.high = np.min(corners, axis=0), np.max(corners, axis=0)

    def include(self, points: FloatArray) -> bool:
        """Make room for points (..., 3) [m]; whether the box had to grow."""
        low, high = points.reshape(-1, 3).min(axis=0), points.reshape(-1, 3).max(axis=0)
        if (low >= self.low).all() and (high <= self.high).all():
            return False
        self.low = np.minimum(self.low, low - self._margin_m)
        self.high = np.maximum(self.high, high + self._margin_m)
        return True


def home(view: SiteView) -> FloatArray:
    """Centre (3,) [m] of the first joint."""
    base: FloatArray = view.chain(np.zeros((1, view.joints)))[0, 0]
    return base


def _reach_m(view: SiteView) -> float:
    # Links keep their length, so any pose tells how far an arm can reach.
    chain = view.chain(np.zeros((1, view.joints)))[0]
    return float(np.linalg.norm(np.diff(chain, axis=0), axis=1).sum())


def blend(colour: Colour, other: Colour, share: float) -> Colour:
    """Mix a share of the other colour into one."""
    r, g, b = (round(c + (o - c) * share) for c, o in zip(colour, other, strict=True))
    return (r, g, b)


def circle(center_m: FloatArray, radius_m: float) -> FloatArray:
    """Points (73, 2) of a circle."""
    angles = np.linspace(0.0, 2.0 * np.pi, 73)
    return center_m[:2] + radius_m * np.column_stack((np.cos(angles), np.sin(angles)))


def wall_lines(wall: WallView, size_m: float, *, spatial: bool) -> list[FloatArray]:
    """Draw a wall as lines (2, 2 or 3): hatched on its far side, or a grid in three dimensions."""
    point, normal = np.array(wall.point_m), np.array(wall.normal)
    normal = normal / np.linalg.norm(normal)
    if spatial:
        # Two directions in the wall, from the axis that is least along the normal.
        first = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
        first /= np.linalg.norm(first)
        second = np.cross(normal, first)
        steps = np.linspace(-0.5, 0.5, 7) * size_m
        return [
            point + np.outer((steps[0], steps[-1]), along) + step * across
            for along, across in ((first, second), (second, first))
            for step in steps
        ]
    normal, point = normal[:2], point[:2]
    along = np.array([-normal[1], normal[0]])
    lines = [point + np.outer((-3 * size_m, 3 * size_m), along)]
    for step in np.arange(-3.0, 3.0, 1 / 15) * size_m:
        foot = point + step * along
        lines.append(np.array([foot, foot + (along - normal) * size_m / 25]))
    return lines
