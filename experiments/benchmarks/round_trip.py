"""Bare Zenoh between two processes that do nothing else: as many bytes as a packet, and back.

`python -m experiments.benchmarks.round_trip echo ENDPOINT`, and `... ping ENDPOINT SECONDS`.
Both have a site's real-time settings, and links as a site's.
"""

import json
import os
import subprocess
import sys
import threading
import time
from typing import Any

import numpy as np
import numpy.typing as npt
import zenoh

from experiments.benchmarks.figures import BenchmarkError
from experiments.benchmarks.sites import free_endpoint
from site_runtime.clock import Pacer, SteadyClock
from site_runtime.real_time import RealTimeSettings, apply_real_time

_PACKET_BYTES = 132  # of a packet of two task dimensions
_PERIOD_NS = 1_000_000
_MEETING_S = 10.0
_PATIENCE_S = 30.0
_PING, _PONG = "farhand/bench/ping", "farhand/bench/pong"


def round_trips_ns(seconds: float) -> npt.NDArray[np.float64]:
    """Return the round trips (n,) [ns] of so many seconds at 1 kHz."""
    endpoint = free_endpoint()
    command = [sys.executable, "-m", __name__]
    with subprocess.Popen(  # noqa: S603 - our own module
        [*command, "echo", endpoint], stdin=subprocess.PIPE, start_new_session=True
    ) as echo:
        try:
            done = subprocess.run(  # noqa: S603
                [*command, "ping", endpoint, str(seconds)],
                stdin=subprocess.DEVNULL,
                capture_output=True,
                text=True,
                timeout=seconds + _PATIENCE_S,
                check=False,
            )
        except subprocess.TimeoutExpired as error:
            raise BenchmarkError("the round trip over bare Zenoh does not end") from error
        finally:
            echo.kill()
    if done.returncode != 0:
        raise BenchmarkError(f"the round trip over bare Zenoh failed: {done.stderr.strip()[-300:]}")
    return np.array(json.loads(done.stdout), dtype=np.float64)


def _open(endpoints: dict[str, str]) -> zenoh.Session:
    config = zenoh.Config()
    settings: dict[str, Any] = {
        "mode": "peer",
        "listen/endpoints": [endpoints["listen"]] if "listen" in endpoints else [],
        "connect/endpoints": [endpoints["connect"]] if "connect" in endpoints else [],
        "connect/timeout_ms": -1,
        "connect/retry": {
            "period_init_ms": 50,
            "period_max_ms": 100,
            "period_increase_factor": 1.5,
        },
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "timestamping/enabled": False,
        "transport/shared_memory/enabled": False,
    }
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


def _publisher(session: zenoh.Session, key: str) -> zenoh.Publisher:
    return session.declare_publisher(
        key,
        congestion_control=zenoh.CongestionControl.DROP,
        priority=zenoh.Priority.REAL_TIME,
        express=True,
        reliability=zenoh.Reliability.BEST_EFFORT,
    )


def echo(endpoint: str) -> None:
    """Send back what comes, until standard input ends."""

    def end_with_owner() -> None:
        sys.stdin.buffer.read()
        os._exit(0)

    threading.Thread(target=end_with_owner, daemon=True).start()
    session = _open({"listen": endpoint})
    publisher = _publisher(session, _PONG)
    pings = session.declare_subscriber(_PING, zenoh.handlers.RingChannel(8))
    with apply_real_time(RealTimeSettings("try")):
        for ping in pings:
            publisher.put(ping.payload)


def ping(endpoint: str, seconds: float) -> None:
    """Send, wait for what comes back, and print how long that took [ns], at 1 kHz."""
    with _open({"connect": endpoint}) as session:
        publisher = _publisher(session, _PING)
        pongs = session.declare_subscriber(_PONG, zenoh.handlers.RingChannel(8))
        payload = bytes(_PACKET_BYTES)
        end_s = time.monotonic() + _MEETING_S
        while pongs.try_recv() is None:
            if time.monotonic() > end_s:
                sys.exit("nobody answers")
            publisher.put(payload)
            time.sleep(0.05)
        time.sleep(0.2)
        while pongs.try_recv() is not None:
            pass
        took_ns = []
        with apply_real_time(RealTimeSettings("try")):
            pacer = Pacer(SteadyClock(), _PERIOD_NS)
            for _ in range(max(round(seconds * 1e9 / _PERIOD_NS), 1)):
                pacer.wait()
                start_ns = time.monotonic_ns()
                publisher.put(payload)
                pongs.recv()
                took_ns.append(time.monotonic_ns() - start_ns)
    sys.stdout.write(json.dumps(took_ns))


if __name__ == "__main__":
    if sys.argv[1] == "echo":
        echo(sys.argv[2])
    else:
        ping(sys.argv[2], float(sys.argv[3]))
