"""From a session file to a site: the same parts for a daemon and for simulation."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from channel.channel import Channel
from channel.link import Link
from hardware.interface import ContactForce, Device, DeviceConfigurationError
from hardware.registry import DeviceContext, driver, force_sensor
from hardware.sensed import SensedDevice
from site_runtime.certification import certify
from site_runtime.clock import Clock
from site_runtime.controller import Controller
from site_runtime.guard import Guard
from site_runtime.keys import SiteId
from site_runtime.parts import limits_of, robot_of
from site_runtime.session import LocalSettings, RemoteSettings, Session
from site_runtime.site import Site, SiteTimes
from site_runtime.supervisor import EngagementTimes, Supervisor
from telemetry.row_ring import Memory
from telemetry.stream import TelemetryStream


@dataclass(frozen=True, slots=True)
class Surroundings:
    """What a site stands in.

    Session time is zero at `session_start_ns` on its clock; `epoch` names this run and differs
    from every other; `publish` takes telemetry and must not block; `shared_clock` says that both
    sites read one clock; `allocate` gives the memory that telemetry rows are kept in.
    """

    link: Link
    clock: Clock
    session_start_ns: int
    epoch: int
    publish: Callable[[bytes], None]
    shared_clock: bool = False
    allocate: Callable[[int], Memory] = bytearray


def device_of(settings: LocalSettings | RemoteSettings, context: DeviceContext) -> Device:
    """Build a site's robot, with its force sensor if it has one.

    Raises DeviceConfigurationError if its driver moves another number of joints.
    """
    device = driver(settings.device.driver).create(settings.device, context)
    if device.joints != context.model.joints:
        raise DeviceConfigurationError(
            f"driver {settings.device.driver!r} moves {device.joints} joints, the robot has "
            f"{context.model.joints}"
        )
    if settings.force_sensor is None:
        return device
    entry = force_sensor(settings.force_sensor.driver)
    return SensedDevice(device, entry.create(settings.force_sensor, context), context.model)


def assemble(
    session: Session,
    identity: SiteId,
    surroundings: Surroundings,
    controller: Controller,
    contact: ContactForce,
) -> Site:
    """Build one site of a session around its controller and what touches its robot."""
    own = session.site(identity)
    inbound = (
        session.channel.remote_to_local
        if identity is SiteId.LOCAL
        else session.channel.local_to_remote
    )
    obstacles = session.remote.obstacles if identity is SiteId.REMOTE else ()
    clock, start_ns = surroundings.clock, surroundings.session_start_ns
    hold_after_ns = round(session.engagement.hold_after_s * 1e9)
    robot = robot_of(session, identity)
    n, z = robot.joints, robot.task_dimension
    context = DeviceContext(robot, contact, clock.now_ns, start_ns, 2 * session.seed + identity)
    return Site(
        identity,
        device=device_of(own, context),
        robot=robot,
        channel=Channel(
            surroundings.link,
            site=identity,
            session_digest=session.digest,
            epoch=surroundings.epoch,
            dimension=z,
            send_period_ns=session.send_period_ns,
            silence_ns=hold_after_ns,
            session_start_ns=start_ns,
            direction=inbound,
            mode=session.channel.injection,
            seed=session.seed,
            shared_clock=surroundings.shared_clock,
        ),
        controller=controller,
        supervisor=Supervisor(EngagementTimes(start_ns, hold_after_ns, session.engagement.blend_s)),
        guard=Guard(limits_of(own.limits, n, z)),
        telemetry=TelemetryStream(
            n,
            z,
            identity,
            session.digest,
            surroundings.epoch,
            surroundings.publish,
            allocate=surroundings.allocate,
        ),
        clock=clock,
        times=SiteTimes(session.period_ns, session.send_period_ns, start_ns),
        certified_round_trip_s=certify(session).best.round_trip_s,
        obstacles_m=tuple(np.array(obstacle.center_m) for obstacle in obstacles),
    )
