"""The least of a site: a loop that drives a session's device, and breaks when told to.

``python -m tests.fakes.loop SESSION --site local|remote`` opens and enables the device and pushes
every motor at the session's rate, to and fro. A line on standard input says how the loop ends, in
the place of its next torque; nothing is stopped or closed then. It prints when that was [ns].
"""

import argparse
import ctypes
import os
import select
import sys
import threading
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from hardware.registry import DeviceContext, driver
from site_runtime.clock import Pacer, SteadyClock
from site_runtime.keys import SiteId
from site_runtime.parts import robot_of
from site_runtime.real_time import apply_real_time
from site_runtime.session import load_session

PUSH_NM = 0.1  # of each motor
TURN_S = 0.1


class LoopError(Exception):
    """What the loop is told to raise."""


def deadlock() -> None:
    """Take a lock that this thread has; the others run on."""
    lock = threading.Lock()
    with lock:
        lock.acquire()


def hold_interpreter() -> None:
    """Wait for ever with the interpreter's lock, as a vendor's call may: no thread runs on."""
    ctypes.PyDLL(None).pause()


def fail() -> None:
    """Raise what nobody catches."""
    raise LoopError("the loop is broken")


ENDINGS: dict[str, Callable[[], None]] = {
    "deadlock": deadlock,
    "interpreter held": hold_interpreter,
    "exception": fail,
}


def main(arguments: Sequence[str] | None = None) -> None:
    """Drive until told how to end."""
    parser = argparse.ArgumentParser(prog="python -m tests.fakes.loop", description=__doc__)
    parser.add_argument("session", type=Path)
    parser.add_argument("--site", choices=[site.label for site in SiteId], required=True)
    given = parser.parse_args(arguments)
    session, site = load_session(given.session), SiteId[given.site.upper()]
    clock = SteadyClock()
    context = DeviceContext(robot_of(session, site), None, clock.now_ns, clock.now_ns(), 0)
    settings = session.site(site).device
    device = driver(settings.driver).create(settings, context)
    # Equal on every motor of a pair of parallel drives: τ_d = Aᵀ τ_q with A = [[1, 0], [-1, 1]].
    torque_nm = PUSH_NM * np.resize([2.0, 1.0], device.joints)
    turn = round(TURN_S * session.loop.rate_hz)
    with apply_real_time(session.real_time):
        device.open()
        device.enable()
        pacer = Pacer(clock, session.period_ns)
        tick = 0
        while True:
            pacer.wait()
            device.read()
            if select.select([sys.stdin], [], [], 0.0)[0]:
                ending = ENDINGS[sys.stdin.readline().strip()]
                os.write(1, f"{clock.now_ns()}\n".encode())
                ending()
            device.write(torque_nm if tick // turn % 2 else -torque_nm)
            tick += 1


if __name__ == "__main__":
    main()
