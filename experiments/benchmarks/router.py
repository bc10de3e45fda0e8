"""A Zenoh router as a process, and the configuration of sites that meet through it.

`python -m experiments.benchmarks.router ENDPOINT` routes until its standard input ends. Peers that
only share a router hear each other if they are of different regions, each with a gateway there.
"""

import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import zenoh

from experiments.benchmarks.figures import BenchmarkError
from experiments.benchmarks.sites import free_endpoint
from site_runtime.keys import SiteId

_COMMON: dict[str, Any] = {
    "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
    "timestamping": {"enabled": False},
    "transport": {
        "link": {
            "tx": {
                "queue": {
                    "congestion_control": {"drop": {"wait_before_drop": 0}},
                    "size": {"real_time": 16, "data_low": 16},
                },
            }
        }
    },
}


@dataclass(frozen=True, slots=True)
class Router:
    """Where it listens, its process, and the configuration files of sites behind it."""

    endpoint: str
    pid: int
    config_files: dict[SiteId, Path]


@contextmanager
def routing() -> Iterator[Router]:
    """Run a router."""
    endpoint = free_endpoint()
    with (
        TemporaryDirectory(prefix="farhand-bench-") as folder,
        subprocess.Popen(  # noqa: S603 - our own module
            [sys.executable, "-m", __name__, endpoint],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,
        ) as process,
    ):
        try:
            assert process.stdout is not None  # noqa: S101 - a pipe was asked for
            if process.stdout.readline() != b"ready\n":
                raise BenchmarkError("the Zenoh router did not start")
            files = {site: Path(folder) / f"{site.label}.json5" for site in SiteId}
            for site, file in files.items():
                file.write_text(json.dumps(_COMMON | _site(site)), encoding="utf-8")
            yield Router(endpoint, process.pid, files)
        finally:
            process.kill()


def _site(site: SiteId) -> dict[str, Any]:
    return {
        "mode": "peer",
        "region_name": site.label,
        "connect": {"timeout_ms": -1, "exit_on_failure": False},
    }


def main(endpoint: str) -> None:
    """Route between the regions of both sites."""
    gateways = [{"filters": [{"region_names": [site.label]}]} for site in SiteId]
    config = zenoh.Config()
    settings = _COMMON | {
        "mode": "router",
        "listen": {"endpoints": [endpoint]},
        "gateway": {"south": gateways},
    }
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    with zenoh.open(config):
        sys.stdout.write("ready\n")
        sys.stdout.flush()
        sys.stdin.read()


if __name__ == "__main__":
    main(sys.argv[1])
