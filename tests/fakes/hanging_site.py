"""A real remote site whose device stops answering at one SIGALRM, and goes on at the next.

python -m tests.fakes.hanging_site SESSION.toml ENDPOINT
"""

import signal
import sys
import time
from pathlib import Path

from hardware.interface import DeviceState
from remote_site.site import build_remote_site
from site_runtime.assembly import Surroundings
from site_runtime.daemon import DaemonOptions, run_daemon
from site_runtime.daemon_log import LogFormat
from site_runtime.keys import SiteId
from site_runtime.session import Session
from site_runtime.site import Site

_ORPHAN_S = 120.0
_hangs = False


def _turn(number: int, frame: object) -> None:
    global _hangs
    _hangs = not _hangs


def _build(session: Session, surroundings: Surroundings) -> Site:
    site = build_remote_site(session, surroundings)
    device = site._device
    answers = device.read

    def read() -> DeviceState:
        while _hangs:  # in the loop's own thread; all others go on
            time.sleep(0.01)
        return answers()

    device.read = read  # type: ignore[method-assign]
    return site


if __name__ == "__main__":
    signal.signal(signal.SIGALRM, _turn)
    options = DaemonOptions(
        connect=(),
        listen=(sys.argv[2],),
        duration_s=_ORPHAN_S,
        quiet=True,
        record=False,
        metrics=None,
        log=LogFormat.TEXT,
    )
    raise SystemExit(run_daemon(SiteId.REMOTE, _build, Path(sys.argv[1]), options))
