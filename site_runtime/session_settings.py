"""The tables and keys of a session file, as frozen dataclasses that pydantic validates.

Descriptions of robots, delays and drivers are the dataclasses of hardware and channel themselves.
A key that may be left out has its default here; `docs/session_file.md` explains every one.
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from types import GenericAlias
from typing import Annotated, Any, ClassVar, Literal

from pydantic import ConfigDict, Field, PlainValidator, TypeAdapter, ValidationError

from channel.delay import ConstantDelay, Direction
from hardware.interface import DeviceConfigurationError, DeviceSettings
from hardware.registry import DriverEntry, SensorEntry, driver, drivers, force_sensor, force_sensors
from hardware.robot_model import RobotDescription
from site_runtime.network_profiles import ProfileName
from site_runtime.real_time import RealTimeSettings
from site_runtime.session_problems import ABSENT, NestedProblems, Problem, explain, nearest

_STRICT = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False)

MOST_HZ = 10_000
"""The fastest loop that a session may ask for."""

Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
Name = Annotated[
    str,
    Field(
        pattern=r"^[A-Za-z0-9_-]{1,64}$",
        description="a text of 1 to 64 letters, digits, - and _",
    ),
]
Locator = Annotated[
    str,
    Field(
        pattern=r"^[a-z0-9-]+/[^\s#?]+",
        description='a Zenoh endpoint, such as "tcp/127.0.0.1:7447"',
    ),
]


@dataclass(frozen=True, slots=True)
class LoopSettings:
    """The control loop of both sites, and how many late ticks in a row lead where."""

    rate_hz: Annotated[int, Field(ge=10, le=MOST_HZ)] = 1000
    late_ticks_to_hold: Annotated[int, Field(ge=1)] = 20
    late_ticks_to_fault: Annotated[int, Field(ge=1)] = 500


@dataclass(frozen=True, slots=True)
class TaskSettings:
    """The space that both end effectors share: 2 is the x-y plane."""

    dimension: Literal[2, 3]


@dataclass(frozen=True, slots=True)
class StiffnessCoupling:
    """Ω P(e) by its stiffness at zero error and its ceiling, per axis."""

    law: Literal["stiffness"]
    stiffness_n_per_m: tuple[Positive, ...]
    force_ceiling_n: tuple[Positive, ...]


@dataclass(frozen=True, slots=True)
class PaperCoupling:
    """Ω_j b_j atan(e_j), as in §VI."""

    law: Literal["paper"]
    omega: tuple[Positive, ...]
    b: tuple[Annotated[float, Field(gt=0, le=1)], ...]


CouplingSettings = StiffnessCoupling | PaperCoupling


@dataclass(frozen=True, slots=True)
class EngagementSettings:
    """How the sites come together, how force comes in and goes, and what silence leads to."""

    alignment: Literal["clutch", "check", "none"] = "clutch"
    align_within_m: Positive = 0.02
    ramp_s: NonNegative = 2.0
    sub_task_ramp_s: NonNegative = 0.5
    release_s: NonNegative = 0.2
    hold_after_s: Positive = 0.1
    stop_after_s: Positive = 30.0
    blend_s: NonNegative = 1.0
    beyond_certificate: Literal["derate", "warn"] = "derate"
    derate_to: Annotated[float, Field(gt=0, le=1)] = 0.25


def _no_delay() -> Direction:
    return Direction(delay=ConstantDelay(delay_s=0.0))


@dataclass(frozen=True, slots=True)
class ChannelSettings:
    """Delay injection, and how often a site sends (None: every tick)."""

    injection: Literal["exact", "added", "off"] = "off"
    send_rate_hz: Annotated[int, Field(ge=1, le=MOST_HZ)] | None = None
    local_to_remote: Direction = field(default_factory=_no_delay)
    remote_to_local: Direction = field(default_factory=_no_delay)
    adapt_send_rate: bool = False


@dataclass(frozen=True, slots=True)
class NetworkSettings:
    """Where the sites meet, and by what right; each machine may have its own."""

    local_listen: Locator = "tcp/127.0.0.1:7448"
    remote_listen: Locator = "tcp/127.0.0.1:7447"
    local_connect: Locator = "tcp/127.0.0.1:7447"
    profile: ProfileName = "lan"
    open_timeout_s: Annotated[float, Field(ge=0.1, le=60)] = 2.0
    lease_s: Annotated[float, Field(ge=0.05, le=60)] = 0.5
    zenoh_config: str | None = None
    security: Literal["none", "mtls"] = "none"
    keys: str | None = None
    router: Locator | None = None
    packets_listen: Locator | None = None
    packets_connect: Locator | None = None
    operator_silence_s: Annotated[float, Field(ge=1, le=3600)] = 10.0
    allow_plaintext: bool = False

    @property
    def seals_packets(self) -> bool:
        """Whether packets of poses go over UDP of their own, sealed."""
        return self.packets_listen is not None or self.packets_connect is not None


@dataclass(frozen=True, slots=True)
class RecorderSettings:
    """Where the flight recorder of this machine writes (None: the user's state), and how much."""

    directory: str | None = None
    keep_s: Positive = 3600.0


@dataclass(frozen=True, slots=True)
class DampingSettings:
    """Λ = diag(joint) + Jᵀ diag(task) J."""

    joint_nm_s: tuple[Positive, ...]
    task_n_s_per_m: tuple[NonNegative, ...]


@dataclass(frozen=True, slots=True)
class LimitSettings:
    """What the guard enforces; None is no limit."""

    torque_nm: tuple[Positive, ...] | None = None
    torque_rate_nm_s: tuple[Positive, ...] | None = None
    velocity_rad_s: tuple[Positive, ...] | None = None
    kinetic_energy_j: Positive | None = None
    joint_min_rad: tuple[float, ...] | None = None
    joint_max_rad: tuple[float, ...] | None = None
    workspace_min_m: tuple[float, ...] | None = None
    workspace_max_m: tuple[float, ...] | None = None
    fault_after_s: Positive = 1.0


def _device(table: object) -> DeviceSettings:
    return _driver_settings(table, drivers(), driver)


def _force_sensor(table: object) -> DeviceSettings:
    return _driver_settings(table, force_sensors(), force_sensor)


def _driver_settings(
    table: object, names: Sequence[str], load: Callable[[str], DriverEntry | SensorEntry]
) -> DeviceSettings:
    """Validate a table against the settings of the driver that it names."""
    if not isinstance(table, dict):
        raise NestedProblems([Problem("", table, "must be a table with driver = a driver's name")])
    name = table.get("driver", ABSENT)
    if name is ABSENT:
        allowed = ", ".join(f'"{known}"' for known in names)
        raise NestedProblems([Problem(".driver", ABSENT, f"is missing; one of {allowed}")])
    if not isinstance(name, str):
        raise NestedProblems([Problem(".driver", name, nearest(name, names))])
    try:
        entry = load(name)
    except DeviceConfigurationError as error:
        reason = str(error) if name in names else nearest(name, names)
        raise NestedProblems([Problem(".driver", name, reason)]) from None
    # A tuple, since it may carry the strict configuration to a class that knows no pydantic.
    annotation: Any = GenericAlias(tuple, (entry.settings,))
    try:
        settings: DeviceSettings = TypeAdapter(annotation, config=_STRICT).validate_json(
            json.dumps([table]),
            context=_device,  # for a device made of others
        )[0]
    except ValidationError as error:
        problems = explain(error, annotation, [table])
        raise NestedProblems(
            [replace(problem, key=problem.key.removeprefix("[0]")) for problem in problems]
        ) from None
    return settings


Device = Annotated[
    DeviceSettings,
    PlainValidator(_device),
    Field(description="a table with driver = a driver's name, and that driver's settings"),
]
ForceSensor = Annotated[
    DeviceSettings | None,
    PlainValidator(_force_sensor),
    Field(description="a table with driver = a force sensor's driver, and that driver's settings"),
]


@dataclass(frozen=True, slots=True)
class NoOperator:
    """Nobody touches the local robot."""

    kind: Literal["none"]


@dataclass(frozen=True, slots=True)
class ConstantOperator:
    """A constant force on the local end effector from `start_s` on."""

    kind: Literal["constant"]
    force_n: tuple[float, ...]
    start_s: NonNegative = 0.0


@dataclass(frozen=True, slots=True)
class Pulse:
    """One sin² pulse along an axis."""

    axis: Literal["x", "y", "z"]
    force_n: float
    start_s: NonNegative
    end_s: Positive


@dataclass(frozen=True, slots=True)
class PulsesOperator:
    """Scripted sin² force pulses on the local end effector."""

    kind: Literal["pulses"]
    pulses: tuple[Pulse, ...]


@dataclass(frozen=True, slots=True)
class HumanArmOperator:
    """A hand that follows x_j(t) = center_j + amplitude_j sin(2π frequency_j t + phase_j).

    It holds the local robot by a spring and a damper, with limited force, and takes hold of it
    smoothly over `grip_s` from `start_s` on.
    """

    kind: Literal["human_arm"]
    stiffness_n_per_m: Positive
    damping_n_s_per_m: NonNegative
    force_limit_n: Positive
    center_m: tuple[float, ...]
    amplitude_m: tuple[NonNegative, ...]
    frequency_hz: tuple[NonNegative, ...]
    phase_rad: tuple[float, ...]
    start_s: NonNegative = 0.0
    grip_s: NonNegative = 1.0


OperatorSettings = NoOperator | ConstantOperator | PulsesOperator | HumanArmOperator


@dataclass(frozen=True, slots=True)
class WallSettings:
    """A plane through `point_m`; `normal` points into the free space."""

    name: str
    point_m: tuple[float, ...]
    normal: tuple[float, ...]
    stiffness_n_per_m: Positive
    damping_n_s_per_m: NonNegative = 0.0


@dataclass(frozen=True, slots=True)
class EnvironmentSettings:
    """What the remote end effector may touch."""

    walls: tuple[WallSettings, ...] = ()


@dataclass(frozen=True, slots=True)
class ObstacleSettings:
    """What the remote links keep away from: never nearer than r, nothing done beyond R."""

    name: str
    center_m: tuple[float, ...]
    collision_radius_m: Positive
    safe_radius_m: Positive


@dataclass(frozen=True, slots=True)
class NullSpaceSettings:
    """The projector's ε [m^2z], and the norm limit of g_r (inf: none)."""

    regularisation: NonNegative = 1e-4
    rate_limit_rad_s: Annotated[
        float, Field(gt=0, allow_inf_nan=True, description="a number greater than 0, or inf")
    ] = 1.0


@dataclass(frozen=True, slots=True)
class LinearSingularityTask:
    """The paper's g = −gain (aᵀq) a."""

    kind: Literal["linear_singularity"]
    gain: Positive
    direction: tuple[float, ...]
    weight: NonNegative = 1.0


@dataclass(frozen=True, slots=True)
class ManipulabilityTask:
    """g = gain ∇det(JJᵀ)."""

    kind: Literal["manipulability"]
    gain: Positive
    weight: NonNegative = 1.0


@dataclass(frozen=True, slots=True)
class PaperObstacleTask:
    """The paper's avoidance, at the links' midpoints; unbounded near the collision radius."""

    kind: Literal["paper_obstacle"]
    gain: Positive
    weight: NonNegative = 1.0


@dataclass(frozen=True, slots=True)
class ObstacleTask:
    """Bounded, smooth avoidance by the whole link segments."""

    kind: Literal["obstacle"]
    gain: Positive
    weight: NonNegative = 1.0


@dataclass(frozen=True, slots=True)
class JointLimitsTask:
    """Toward the middle of each joint's range; None takes the URDF's limits."""

    kind: Literal["joint_limits"]
    gain: Positive
    lower_rad: tuple[float, ...] | None = None
    upper_rad: tuple[float, ...] | None = None
    weight: NonNegative = 1.0


SubTaskSettings = (
    LinearSingularityTask | ManipulabilityTask | PaperObstacleTask | ObstacleTask | JointLimitsTask
)


@dataclass(frozen=True, slots=True, kw_only=True)
class LocalSettings:
    """The operator's side."""

    robot: RobotDescription
    damping: DampingSettings
    device: Device
    force_sensor: ForceSensor = None
    limits: LimitSettings = LimitSettings()
    operator: OperatorSettings = NoOperator("none")


@dataclass(frozen=True, slots=True, kw_only=True)
class RemoteSettings:
    """The far side."""

    robot: RobotDescription
    damping: DampingSettings
    device: Device
    force_sensor: ForceSensor = None
    limits: LimitSettings = LimitSettings()
    environment: EnvironmentSettings = EnvironmentSettings()
    obstacles: tuple[ObstacleSettings, ...] = ()
    null_space: NullSpaceSettings = NullSpaceSettings()
    sub_tasks: tuple[SubTaskSettings, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class SessionFile:
    """The keys of a session file."""

    __pydantic_config__: ClassVar[ConfigDict] = _STRICT

    format: Literal[1]
    name: Name
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 0
    loop: LoopSettings = LoopSettings()
    real_time: RealTimeSettings = field(default_factory=RealTimeSettings)
    task: TaskSettings
    coupling: CouplingSettings
    engagement: EngagementSettings = EngagementSettings()
    channel: ChannelSettings = ChannelSettings()
    network: NetworkSettings = NetworkSettings()
    recorder: RecorderSettings = RecorderSettings()
    local: LocalSettings
    remote: RemoteSettings

    @property
    def period_ns(self) -> int:
        """Period of the control loop [ns]."""
        return round(1e9 / self.loop.rate_hz)

    @property
    def send_period_ns(self) -> int:
        """Time between two packets of a site [ns], a whole number of ticks."""
        send_rate_hz = self.channel.send_rate_hz or self.loop.rate_hz
        return self.period_ns * (self.loop.rate_hz // send_rate_hz)
