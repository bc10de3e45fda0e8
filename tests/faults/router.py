"""A Zenoh router as a process, and the configuration of sites that meet through it.

Peers that only share a router do not hear each other unless they are of different regions, each
with a gateway of its own in the router.
"""

import json
import sys
from pathlib import Path
from typing import Any

import zenoh

from site_runtime.keys import SiteId

LEASE_MS = 1000
_COMMON = {
    "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
    "timestamping": {"enabled": False},
    "transport": {
        "link": {
            "tx": {
                "lease": LEASE_MS,
                "queue": {
                    "congestion_control": {"drop": {"wait_before_drop": 0}},
                    "size": {"real_time": 16, "data_low": 16},
                },
            }
        }
    },
}


def write_site_config(path: Path, site: SiteId) -> Path:
    """Write the Zenoh configuration of a site behind the router and return its path."""
    own: dict[str, Any] = {
        "mode": "peer",
        "region_name": site.label,
        "connect": {
            "timeout_ms": -1,
            "exit_on_failure": False,
            "retry": {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 1.5},
        },
    }
    path.write_text(json.dumps(_COMMON | own), encoding="utf-8")
    return path


def route(endpoint: str) -> None:
    """Route between the regions of both sites until standard input ends."""
    config = zenoh.Config()
    gateways = [{"filters": [{"region_names": [site.label]}]} for site in SiteId]
    settings: dict[str, Any] = _COMMON | {
        "mode": "router",
        "listen": {"endpoints": [endpoint]},
        "gateway": {"south": gateways},
    }
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    with zenoh.open(config):
        sys.stdout.write("ready\n")
        sys.stdout.flush()
        sys.stdin.read()  # until its owner ends


if __name__ == "__main__":
    route(sys.argv[1])
