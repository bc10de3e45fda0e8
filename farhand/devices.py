"""`farhand devices` and `farhand device-check`."""

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from math import isfinite
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import numpy.typing as npt
import typer
from rich.markup import escape
from rich.table import Table

from farhand.console import ERR, OUT, say, user_errors
from hardware.interface import Device, DeviceConfigurationError
from hardware.registry import (
    DeviceContext,
    driver,
    drivers,
    force_sensor,
    force_sensors,
    missing,
)
from site_runtime.assembly import device_of
from site_runtime.clock import SteadyClock
from site_runtime.daemon import SessionPath, StopSignals
from site_runtime.device_check import (
    Answer,
    Interrupted,
    Push,
    Readings,
    TorqueTest,
    watch,
)
from site_runtime.guard import Guard
from site_runtime.keys import SiteId
from site_runtime.parts import limits_of, robot_of
from site_runtime.session import Session, SessionError, load_session

EXIT_FAILED = 1


def devices(
    session: Annotated[
        Path | None,
        typer.Argument(metavar="[SESSION.toml]", help="Ask for this session's devices only."),
    ] = None,
) -> None:
    """List drivers and what this machine lacks for them. Exit code 1: a session lacks something."""
    with user_errors():
        rows = list(_all_drivers()) if session is None else list(_drivers_of(load_session(session)))
    table = Table()
    for heading in ("driver", "of", "on this machine"):
        table.add_column(heading, overflow="fold")
    for name, what, lack in rows:
        words = "[green]nothing missing[/green]" if lack is None else f"[red]{escape(lack)}[/red]"
        table.add_row(escape(name), what, words)
    OUT.print(table)
    if session is not None and any(lack is not None for _, _, lack in rows):
        raise typer.Exit(EXIT_FAILED)


def _all_drivers() -> Iterator[tuple[str, str, str | None]]:
    for names, load, what in (
        (drivers(), driver, "device"),
        (force_sensors(), force_sensor, "force sensor"),
    ):
        for name in names:
            try:
                yield name, what, missing(load(name))
            except DeviceConfigurationError as error:
                yield name, what, str(error)


def _drivers_of(session: Session) -> Iterator[tuple[str, str, str | None]]:
    for identity in SiteId:
        site = session.site(identity)
        name = site.device.driver
        yield name, f"{identity.label} device", missing(driver(name), site.device)
        if site.force_sensor is not None:
            name = site.force_sensor.driver
            lack = missing(force_sensor(name), site.force_sensor)
            yield name, f"{identity.label} force sensor", lack


def device_check(
    session: SessionPath,
    site: Annotated[Literal["local", "remote"], typer.Option("--site", help="Which site's robot.")],
    seconds: Annotated[
        float, typer.Option("--seconds", help="How long to read, torque off [s].", min=0.1)
    ] = 5.0,
    torque: Annotated[
        bool, typer.Option("--torque", help="Then push every joint a little; asks before.")
    ] = False,
    share: Annotated[
        float,
        typer.Option("--share", help="Of limits.torque_nm, to push with.", min=0.001, max=0.5),
    ] = 0.05,
    motion: Annotated[
        float, typer.Option("--motion", help="Travel that ends a push [rad].", min=0.005, max=0.5)
    ] = 0.05,
    yes: Annotated[bool, typer.Option("--yes", help="Push without asking, for scripts.")] = False,
    fake: Annotated[
        bool, typer.Option("--fake", help="Among a source tree's fakes in place of hardware.")
    ] = False,
) -> None:
    """Read a site's robot with torque off; with --torque, push each joint a little.

    Exit code 1 if a joint answers wrongly, 2 if the device cannot be used.
    """
    with user_errors():
        if fake:
            options = ["--site", site, f"--seconds={seconds}", f"--share={share}"]
            options += [f"--motion={motion}", *["--torque"] * torque, *["--yes"] * yes]
            raise typer.Exit(_among_fakes(session, site, ["device-check", str(session), *options]))
        loaded = load_session(session)
        identity = SiteId[site.upper()]
        clock = SteadyClock()
        device = _device(loaded, identity, clock)
        test_torque_nm = _test_torque_nm(loaded, identity, share) if torque else None
        with _opened(device):
            with StopSignals(clock, None) as signals:
                readings = watch(device, clock, loaded.period_ns, seconds, signals.asked_to_stop)
            _print_readings(loaded, identity, readings)
            if test_torque_nm is None or not (yes or _confirmed(test_torque_nm, motion)):
                return
            with StopSignals(clock, None) as signals:
                own = loaded.site(identity)
                robot = robot_of(loaded, identity)
                pushes = TorqueTest(
                    device,
                    robot,
                    Guard(
                        limits_of(own.limits, robot, device.joint_stops), loaded.period_ns * 1e-9
                    ),
                    clock,
                    loaded.period_ns,
                    torque_nm=test_torque_nm,
                    motion_rad=motion,
                    should_stop=signals.asked_to_stop,
                ).run()
    _print_pushes(pushes)
    if any(push.answer is not Answer.FOLLOWED for push in pushes):
        raise typer.Exit(EXIT_FAILED)


def _among_fakes(session: Path, site: str, arguments: list[str]) -> int:
    """Run a command where fakes stand in for the session's hardware; return its exit code."""
    root = Path(__file__).resolve().parents[1]
    if not (root / "tests" / "fakes" / "bench.py").is_file():
        raise SessionError("--fake: the fakes come with farhand's source tree, not with a package")
    fakes = ["-m", "tests.fakes.bench", str(session), "--site", site, "--"]
    command = [sys.executable, *fakes, sys.executable, "-m", "farhand", *arguments]
    paths = os.pathsep.join(filter(None, (str(root), os.environ.get("PYTHONPATH"))))
    return subprocess.run(  # noqa: S603  our own modules
        command, env=os.environ | {"PYTHONPATH": paths}, check=False
    ).returncode


def _device(session: Session, identity: SiteId, clock: SteadyClock) -> Device:
    """Build the site's robot; nobody touches it, if it is simulated."""
    robot = robot_of(session, identity)
    context = DeviceContext(robot, None, clock.now_ns, clock.now_ns(), session.seed)
    return device_of(session.site(identity), context)


def _test_torque_nm(session: Session, identity: SiteId, share: float) -> npt.NDArray[np.float64]:
    limits = session.site(identity).limits.torque_nm
    if limits is None:
        raise SessionError(
            f"{session.path}: {identity.label}.limits.torque_nm is missing; "
            "--torque pushes with a share of it"
        )
    return share * np.array(limits)


@contextmanager
def _opened(device: Device) -> Iterator[None]:
    """Open the device; it is stopped and closed however this ends."""
    device.open()
    try:
        yield
    except Interrupted:
        ERR.print("stopped, as asked")
        raise typer.Exit(EXIT_FAILED) from None
    finally:
        device.stop()
        device.close()


def _confirmed(torque_nm: npt.NDArray[np.float64], motion_rad: float) -> bool:
    say(
        f"Each joint will be pushed with up to {escape(_numbers(torque_nm))} N·m, "
        f"until it has moved {motion_rad:g} rad. Keep hands off, the emergency stop at hand."
    )
    return typer.confirm("Push?")


def _print_readings(session: Session, identity: SiteId, readings: Readings) -> None:
    say(
        f"{identity.label} device ({escape(session.site(identity).device.driver)}), torque off: "
        f"{readings.rate_hz:.0f} readings/s of {session.loop.rate_hz} asked, "
        f"{readings.fresh_hz:.0f} of them new"
    )
    say(f"  age of a reading    {_spread(readings.age_s)}")
    say(f"  duration of a read  {_spread(readings.duration_s)}")
    table = Table()
    for heading in ("", "mean", "standard deviation"):
        table.add_column(heading, justify="left" if not heading else "right")
    for joint, values in enumerate(
        zip(
            readings.position_rad,
            readings.position_noise_rad,
            readings.velocity_rad_s,
            readings.velocity_noise_rad_s,
            strict=True,
        ),
        start=1,
    ):
        q, q_noise, q_dot, q_dot_noise = values
        table.add_row(f"q{joint} \\[rad]", f"{q:.5f}", f"{q_noise:.2e}")
        table.add_row(f"q̇{joint} \\[rad/s]", f"{q_dot:.5f}", f"{q_dot_noise:.2e}")
    for axis, mean, noise in zip(
        ("Fx [N]", "Fy [N]", "Fz [N]", "Mx [N·m]", "My [N·m]", "Mz [N·m]"),
        readings.wrench,
        readings.wrench_noise,
        strict=True,
    ):
        table.add_row(escape(axis), f"{mean:.4f}", f"{noise:.2e}")
    OUT.print(table)


def _print_pushes(pushes: list[Push]) -> None:
    table = Table()
    for heading in ("joint", "torque [N·m]", "its travel [rad]", "others' [rad]", "answer"):
        table.add_column(escape(heading), justify="right" if "[" in heading else "left")
    for push in pushes:
        others_rad = np.abs(np.delete(push.travel_rad, push.joint)).max(initial=0.0)
        table.add_row(
            f"{push.joint + 1}",
            f"{push.torque_nm:+.4f}",
            f"{push.travel_rad[push.joint]:+.4f}",
            f"{others_rad:.4f}",
            push.answer.value
            if push.answer is Answer.FOLLOWED
            else f"[red]{push.answer.value}[/red]",
        )
    OUT.print(table)


def _spread(values_s: npt.NDArray[np.float64]) -> str:
    median, most, worst = (f"{value * 1e3:.2f}" if isfinite(value) else "?" for value in values_s)
    return f"median {median}, 99 % {most}, worst {worst} ms"


def _numbers(values: npt.NDArray[np.float64]) -> str:
    return ", ".join(f"{value:.3g}" for value in values)
