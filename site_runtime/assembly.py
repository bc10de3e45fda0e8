"""From a session file to a site: the same parts for a daemon and for simulation."""

from collections.abc import Callable
from dataclasses import dataclass, field
from math import inf

from channel.channel import Channel
from channel.link import Link, TappedLink
from hardware.interface import ContactForce, Device, DeviceConfigurationError
from hardware.registry import DeviceContext, driver, force_sensor
from hardware.sensed import SensedDevice
from site_runtime.certification import slowest_send_period_ns
from site_runtime.clock import Clock
from site_runtime.controller import Controller
from site_runtime.guard import Guard
from site_runtime.keys import SiteId
from site_runtime.margin import margin_of
from site_runtime.operator_requests import OperatorRequests
from site_runtime.parts import limits_of, robot_of
from site_runtime.session import LocalSettings, RemoteSettings, Session
from site_runtime.site import Site, SiteTimes
from site_runtime.supervisor import EngagementRules, Supervisor
from telemetry.row_ring import Memory
from telemetry.stream import TelemetryStream

TAKEOVER_NS = 1_000_000_000
"""Silence after which another run may take the peer's place.

No start is quicker, and a brief outage must not hand the robot to a second operator who waits.
"""


@dataclass(frozen=True, slots=True)
class Surroundings:
    """What a site stands in.

    Session time is zero at `session_start_ns` on its clock; `epoch` names this run and differs
    from every other; `publish` takes telemetry and must not block; `shared_clock` says that both
    sites read one clock; `requests` are those of this site's operator; `allocate` gives the memory
    that telemetry rows are kept in; `in_place_of` may put another device in the session's place.
    """

    link: Link
    clock: Clock
    session_start_ns: int
    epoch: int
    publish: Callable[[bytes], None]
    shared_clock: bool = False
    requests: OperatorRequests = field(default_factory=OperatorRequests)
    allocate: Callable[[int], Memory] = bytearray
    in_place_of: Callable[[Device], Device] = lambda device: device


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
    contact: ContactForce | None,
) -> Site:
    """Build one site of a session around its controller and whatever touches its robot."""
    own = session.site(identity)
    inbound = (
        session.channel.remote_to_local
        if identity is SiteId.LOCAL
        else session.channel.local_to_remote
    )
    clock, start_ns = surroundings.clock, surroundings.session_start_ns
    hold_after_ns = round(session.engagement.hold_after_s * 1e9)
    robot = robot_of(session, identity)
    n, z = robot.joints, robot.task_dimension
    context = DeviceContext(robot, contact, clock.now_ns, start_ns, 2 * session.seed + identity)
    device = surroundings.in_place_of(device_of(own, context))
    telemetry = TelemetryStream(
        n,
        z,
        identity,
        session.digest,
        surroundings.epoch,
        surroundings.publish,
        allocate=surroundings.allocate,
    )
    return Site(
        identity,
        device=device,
        robot=robot,
        channel=Channel(
            TappedLink(surroundings.link, telemetry.arrived),
            site=identity,
            session_digest=session.digest,
            epoch=surroundings.epoch,
            dimension=z,
            send_period_ns=session.send_period_ns,
            silence_ns=max(TAKEOVER_NS, hold_after_ns),
            session_start_ns=start_ns,
            direction=inbound,
            mode=session.channel.injection,
            seed=session.seed,
            shared_clock=surroundings.shared_clock,
            slowest_send_period_ns=slowest_send_period_ns(session),
        ),
        controller=controller,
        supervisor=Supervisor(engagement_rules(session, identity, start_ns), z),
        margin=margin_of(session),
        guard=Guard(limits_of(own.limits, robot, device.joint_stops), session.period_ns * 1e-9),
        telemetry=telemetry,
        clock=clock,
        times=SiteTimes(
            session.period_ns,
            session.send_period_ns,
            start_ns,
            session.loop.late_ticks_to_hold,
            session.loop.late_ticks_to_fault,
        ),
        requests=surroundings.requests,
    )


def engagement_rules(session: Session, identity: SiteId, not_before_ns: int) -> EngagementRules:
    """Return when and how one site of a session engages, on its clock."""
    engagement = session.engagement
    return EngagementRules(
        not_before_ns=not_before_ns,
        hold_after_ns=round(engagement.hold_after_s * 1e9),
        stop_after_ns=round(engagement.stop_after_s * 1e9),
        ramp_s=engagement.ramp_s,
        release_s=engagement.release_s,
        blend_s=engagement.blend_s,
        align_within_m=inf if engagement.alignment == "none" else engagement.align_within_m,
        derate_to=engagement.derate_to,
        leads=identity is SiteId.LOCAL,
        clutched=engagement.alignment == "clutch",
    )
