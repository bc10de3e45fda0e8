"""Contradictions in a session file: what no key shows by itself."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import fields

from hardware.interface import HardwareError
from hardware.robot_model import PlanarArm, RobotDescription, UrdfArm, build_robot
from site_runtime.session_problems import ABSENT, Problem
from site_runtime.session_settings import (
    JointLimitsTask,
    LinearSingularityTask,
    LocalSettings,
    NetworkSettings,
    ObstacleTask,
    OperatorSettings,
    PaperObstacleTask,
    PulsesOperator,
    RemoteSettings,
    SessionFile,
)

DIRECTIONS = ("local_to_remote", "remote_to_local")


def contradictions(file: SessionFile) -> Iterator[Problem]:
    """Yield every contradiction between keys, and every file a key names that cannot be used."""
    dimension = file.task.dimension
    yield from _rates(file)
    yield from _network(file.network)
    for name in DIRECTIONS:
        try:
            _ = getattr(file.channel, name).bound_s  # reads a recorded trace
        except ValueError as error:
            yield Problem(f"channel.{name}.delay", ABSENT, str(error))
    yield from _same_length(
        "coupling", file.coupling, _vectors(file.coupling), dimension, "one per task axis"
    )
    joints: dict[str, int] = {}
    for name, site in (("local", file.local), ("remote", file.remote)):
        try:
            joints[name] = _joints(site.robot)
        except (HardwareError, OSError, ValueError) as error:
            yield Problem(f"{name}.robot", ABSENT, str(error))
            continue
        yield from _site(name, site, joints[name], dimension)
    yield from _operator(file.local.operator, dimension)
    yield from _surroundings(file.remote, dimension)
    if "remote" in joints:
        yield from _sub_tasks(file.remote, joints["remote"], dimension)


def _network(network: NetworkSettings) -> Iterator[Problem]:
    """Yield what contradicts itself; what endpoints may be is a matter of opening the network."""
    if network.security == "mtls" and network.keys is None:
        yield Problem(
            "network.keys",
            ABSENT,
            'is missing: security = "mtls" needs the folder that `farhand keys` makes',
        )
    for key in ("packets_listen", "packets_connect"):
        place = getattr(network, key)
        if place is None:
            continue
        if not place.startswith("udp/"):
            yield Problem(
                f"network.{key}",
                place,
                "must be a udp/ endpoint: sealed packets need no other protection",
            )
        if network.security != "mtls":
            yield Problem(
                f"network.{key}",
                place,
                'needs security = "mtls": the certificates sign the keys that seal packets',
            )
    if network.zenoh_config is not None:
        for key, given in (("security", network.security != "none"), ("router", network.router)):
            if given:
                yield Problem(
                    f"network.{key}",
                    getattr(network, key),
                    "does not go with zenoh_config, a configuration of your own",
                )


def _rates(file: SessionFile) -> Iterator[Problem]:
    rate_hz, send_rate_hz = file.loop.rate_hz, file.channel.send_rate_hz
    if send_rate_hz is not None and (send_rate_hz > rate_hz or rate_hz % send_rate_hz):
        yield Problem(
            "channel.send_rate_hz",
            send_rate_hz,
            f"must divide loop.rate_hz = {rate_hz}: a site sends on every k-th tick",
        )
    spacing_s = 1.0 / (send_rate_hz or rate_hz)
    if file.engagement.hold_after_s < 3.0 * spacing_s:
        yield Problem(
            "engagement.hold_after_s",
            file.engagement.hold_after_s,
            f"must be at least three times the {spacing_s:g} s between packets, "
            "else every lost packet is a silent peer",
        )
    engagement, loop = file.engagement, file.loop
    if engagement.stop_after_s < engagement.release_s:
        yield Problem(
            "engagement.stop_after_s",
            engagement.stop_after_s,
            f"must be at least release_s = {engagement.release_s}, in which the force goes",
        )
    if loop.late_ticks_to_fault < loop.late_ticks_to_hold:
        yield Problem(
            "loop.late_ticks_to_fault",
            loop.late_ticks_to_fault,
            f"must be at least late_ticks_to_hold = {loop.late_ticks_to_hold}",
        )


def _joints(robot: RobotDescription) -> int:
    return len(robot.lengths_m) if isinstance(robot, PlanarArm) else build_robot(robot, None).joints


def _site(
    name: str, site: LocalSettings | RemoteSettings, joints: int, dimension: int
) -> Iterator[Problem]:
    robot_dimension = 2 if isinstance(site.robot, PlanarArm) else site.robot.task_dimension
    if robot_dimension != dimension:
        yield Problem(
            f"{name}.robot",
            ABSENT,
            f"moves in {robot_dimension} dimensions, but task.dimension = {dimension}",
        )
    if joints < dimension:
        yield Problem(
            f"{name}.robot", ABSENT, f"has {joints} joints; a task of {dimension} needs as many"
        )
    per_joint, per_axis = "one per joint", "one per task axis"
    limits = site.limits
    yield from _same_length(f"{name}.damping", site.damping, ("joint_nm_s",), joints, per_joint)
    yield from _same_length(
        f"{name}.damping", site.damping, ("task_n_s_per_m",), dimension, per_axis
    )
    yield from _same_length(
        f"{name}.device", site.device, ("initial_position_rad",), joints, per_joint
    )
    yield from _same_length(
        f"{name}.limits",
        limits,
        ("torque_nm", "torque_rate_nm_s", "velocity_rad_s"),
        joints,
        per_joint,
    )
    stops = ("joint_min_rad", "joint_max_rad")
    yield from _same_length(f"{name}.limits", limits, stops, joints, per_joint)
    yield from _ordered(f"{name}.limits", limits, *stops)
    box = ("workspace_min_m", "workspace_max_m")
    yield from _same_length(f"{name}.limits", limits, box, dimension, per_axis)
    yield from _ordered(f"{name}.limits", limits, *box)
    if site.device.driver != "simulated":
        for key in ("torque_nm", "velocity_rad_s"):
            if getattr(limits, key) is None:
                yield Problem(
                    f"{name}.limits.{key}", ABSENT, "is missing; a real robot needs its limits"
                )


def _operator(operator: OperatorSettings, dimension: int) -> Iterator[Problem]:
    if isinstance(operator, PulsesOperator):
        axes = "xyz"[:dimension]
        for index, pulse in enumerate(operator.pulses):
            key = f"local.operator.pulses[{index}]"
            if pulse.axis not in axes:
                yield Problem(f"{key}.axis", pulse.axis, f"must be one of {', '.join(axes)}")
            if pulse.end_s <= pulse.start_s:
                yield Problem(
                    f"{key}.end_s", pulse.end_s, f"must be after start_s = {pulse.start_s}"
                )
    else:
        yield from _same_length(
            "local.operator", operator, _vectors(operator), dimension, "one per task axis"
        )


def _surroundings(remote: RemoteSettings, dimension: int) -> Iterator[Problem]:
    for index, wall in enumerate(remote.environment.walls):
        key = f"remote.environment.walls[{index}]"
        yield from _same_length(key, wall, ("point_m", "normal"), dimension, "one per task axis")
        if not any(wall.normal):
            yield Problem(f"{key}.normal", wall.normal, "must not be zero: it tells the free side")
    for index, obstacle in enumerate(remote.obstacles):
        key = f"remote.obstacles[{index}]"
        yield from _same_length(key, obstacle, ("center_m",), dimension, "one per task axis")
        if obstacle.safe_radius_m <= obstacle.collision_radius_m:
            yield Problem(
                f"{key}.safe_radius_m",
                obstacle.safe_radius_m,
                f"must be greater than collision_radius_m = {obstacle.collision_radius_m}",
            )
    for key, items in (
        ("remote.environment.walls", remote.environment.walls),
        ("remote.obstacles", remote.obstacles),
    ):
        names = [item.name for item in items]
        for index, name in enumerate(names):
            if name in names[:index]:
                yield Problem(f"{key}[{index}].name", name, "is taken; names must differ")


def _sub_tasks(remote: RemoteSettings, joints: int, dimension: int) -> Iterator[Problem]:
    if remote.sub_tasks and joints <= dimension:
        yield Problem(
            "remote.sub_tasks",
            ABSENT,
            f"need a redundant robot: {joints} joints leave nothing beside a task of {dimension}",
        )
    for index, task in enumerate(remote.sub_tasks):
        key = f"remote.sub_tasks[{index}]"
        yield from _same_length(key, task, _vectors(task), joints, "one per joint")
        if isinstance(task, LinearSingularityTask) and not any(task.direction):
            yield Problem(f"{key}.direction", task.direction, "must not be zero")
        elif isinstance(task, PaperObstacleTask | ObstacleTask) and not remote.obstacles:
            yield Problem(f"{key}.kind", task.kind, "needs at least one [[remote.obstacles]]")
        elif isinstance(task, JointLimitsTask):
            yield from _joint_limits(key, task, remote.robot)


def _joint_limits(key: str, task: JointLimitsTask, robot: RobotDescription) -> Iterator[Problem]:
    lower, upper = task.lower_rad, task.upper_rad
    yield from _ordered(key, task, "lower_rad", "upper_rad")
    if lower is None and upper is None:
        low, high = (
            build_robot(robot, None).position_limits_rad if isinstance(robot, UrdfArm) else ((), ())
        )
        if not any(map(math.isfinite, [*low, *high])):
            yield Problem(
                f"{key}.lower_rad", ABSENT, "is missing, and the robot's joints have no limits"
            )


def _vectors(table: object) -> tuple[str, ...]:
    """Name the keys of a table whose values are lists."""
    return tuple(
        item.name
        for item in fields(table)  # type: ignore[arg-type]
        if isinstance(getattr(table, item.name), tuple)
    )


def _same_length(
    key: str, table: object, names: Sequence[str], length: int, per: str
) -> Iterator[Problem]:
    for name in names:
        values = getattr(table, name, None)
        if values is not None and len(values) != length:
            yield Problem(
                f"{key}.{name}", values, f"has {len(values)} numbers; {length} are needed, {per}"
            )


def _ordered(key: str, table: object, lower: str, upper: str) -> Iterator[Problem]:
    """Require of two bounds both or none, and every item in order."""
    low, high = getattr(table, lower), getattr(table, upper)
    if low is None and high is None:
        return
    if low is None or high is None:
        missing, given = (lower, upper) if low is None else (upper, lower)
        yield Problem(f"{key}.{missing}", ABSENT, f"is missing; {given} alone is not a range")
        return
    for index, (least, most) in enumerate(zip(low, high, strict=False)):
        if least >= most:
            yield Problem(
                f"{key}.{upper}[{index}]", most, f"must be greater than {lower} = {least}"
            )
