"""Metrics and logs of real daemons, scraped by a real Prometheus server."""

import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.parse
import urllib.request
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from math import isfinite
from pathlib import Path
from string import Template
from typing import Any

import pytest
from prometheus_client.parser import text_string_to_metric_families

from site_runtime.keys import SiteId
from site_runtime.session import load_session
from tests.ports import free_port

pytestmark = pytest.mark.processes

ROOT = Path(__file__).parents[2]
LOCAL, REMOTE = SiteId.LOCAL, SiteId.REMOTE
DEADLINE_S = 30.0
ORPHAN_S = "150"  # a daemon whose test was killed ends by itself

# Heavy links and weak gains: calm also where ticks come late on a crowded machine.
SESSION = Template("""
format = 1
name = "metered"
loop = { rate_hz = 500 }
task = { dimension = 2 }
coupling = { law = "stiffness", stiffness_n_per_m = [100.0, 100.0], force_ceiling_n = [9.0, 9.0] }
engagement = { alignment = "none", ramp_s = 0.2, hold_after_s = 0.3 }
[channel]
injection = "exact"
local_to_remote = { delay = { model = "constant", delay_s = 0.03 } }
remote_to_local = { delay = { model = "constant", delay_s = 0.05 } }
[network]
local_listen = "$local"
remote_listen = "$remote"
local_connect = "$remote"
[local]
damping = { joint_nm_s = [0.2, 0.2], task_n_s_per_m = [15.0, 15.0] }
device = { driver = "simulated", initial_position_rad = [-0.3, 1.65] }
robot = { kind = "planar", lengths_m = [0.4, 0.4], masses_kg = [1.0, 1.0] }
[remote]
damping = { joint_nm_s = [0.2, 0.2], task_n_s_per_m = [15.0, 15.0] }
device = { driver = "simulated", initial_position_rad = [-0.3, 1.65] }
robot = { kind = "planar", lengths_m = [0.4, 0.4], masses_kg = [1.0, 1.0] }
""")


def until(condition: Callable[[], object], what: Callable[[], str]) -> None:
    end_s = time.monotonic() + DEADLINE_S
    while not condition():
        if time.monotonic() > end_s:
            pytest.fail(f"not within {DEADLINE_S} s: {what()}")
        time.sleep(0.02)


def read(url: str) -> str:
    with urllib.request.urlopen(url, timeout=DEADLINE_S) as answer:  # noqa: S310 - http, ours
        return str(answer.read().decode())


class Daemon:
    """One `python -m ..._site`; stdout and stderr in a file each."""

    def __init__(self, site: SiteId, session: Path, *options: str) -> None:
        self.site = site
        self.out = session.with_name(f"{site.label}.out")
        self.err = session.with_name(f"{site.label}.err")
        with self.out.open("wb") as out, self.err.open("wb") as err:
            self.process = subprocess.Popen(
                [
                    *(sys.executable, "-m", f"{site.label}_site", str(session)),
                    *("--duration", ORPHAN_S, *options),
                ],
                cwd=ROOT,
                stdout=out,
                stderr=err,
                env=os.environ | {"XDG_STATE_HOME": str(session.parent / "state")},
            )

    def said(self) -> str:
        return self.err.read_text(encoding="utf-8")

    def until_said(self, pattern: str) -> "re.Match[str]":
        until(lambda: re.search(pattern, self.said()), lambda: f"{pattern} in\n{self.said()}")
        found = re.search(pattern, self.said())
        assert found is not None
        return found

    @property
    def url(self) -> str:
        return self.until_said(r"metrics at (http://127\.0\.0\.1:\d+/metrics)")[1]

    def scrape(self) -> dict[str, float]:
        """Samples by name and the value of their own label."""
        return {
            " ".join([sample.name, *map(str, own.values())]): sample.value
            for family in text_string_to_metric_families(read(self.url))
            for sample in family.samples
            for own in [{k: v for k, v in sample.labels.items() if k not in ("session", "site")}]
            if "digest" not in own
        }

    def metrics_pid(self) -> int:
        children = Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children")
        [pid] = [
            int(pid)
            for pid in children.read_text(encoding="ascii").split()
            if b"telemetry.metrics.server" in Path(f"/proc/{pid}/cmdline").read_bytes()
        ]
        return pid

    def stop(self) -> int:
        self.process.send_signal(signal.SIGINT)
        return self.process.wait(DEADLINE_S)

    def close(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()


def write_session(folder: Path) -> Path:
    session = folder / "session.toml"
    endpoints = {site.label: f"tcp/127.0.0.1:{free_port()}" for site in SiteId}
    session.write_text(SESSION.substitute(endpoints), encoding="utf-8")
    return session


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[SiteId, Daemon]]:
    session = write_session(tmp_path_factory.mktemp("pair"))
    daemons = {site: Daemon(site, session, "--metrics", "0") for site in (REMOTE, LOCAL)}
    try:
        for daemon in daemons.values():
            until(
                lambda daemon=daemon: daemon.scrape()["farhand_state ENGAGED"] == 1,  # type: ignore[misc]
                lambda daemon=daemon: f"ENGAGED\n{daemon.said()}",  # type: ignore[misc]
            )
        yield daemons
    finally:
        for daemon in daemons.values():
            daemon.close()


def implausible(
    found: dict[str, float], more: dict[str, float], delay_s: float
) -> dict[str, float]:
    """What does not fit to a second of an engaged pair with this injected delay."""
    ran = more["farhand_ticks_total"]
    samples = more["farhand_hold_seconds_count"]
    held_s, on_the_way_s, one_way_s = (
        more[f"farhand_{name}_seconds_sum"] / max(more[f"farhand_{name}_seconds_count"], 1)
        for name in ("hold", "network_delay", "one_way_delay")
    )
    judged = {
        "rate": (ran + more["farhand_missed_ticks_total"], 400, 700),
        "round trips": (more["farhand_round_trip_seconds_count"] / ran, 0.9, 1.0),
        "delays": (more["farhand_one_way_delay_seconds_count"] / ran, 0.9, 1.0),
        "samples": (samples / ran, 0.1, 1.0),
        "held and on the way": (held_s + on_the_way_s, 0.9 * delay_s, 1.2 * one_way_s),
        "margin": (found["farhand_margin_seconds"], -1.0, 0.3 - 0.08),
        "force share": (found["farhand_force_share"], 0.01, 1.0),
        "uncertainty": (found["farhand_clock_uncertainty_seconds"], 1e-9, 1.0),
    }
    return {name: value for name, (value, low, high) in judged.items() if not low <= value <= high}


def test_a_scrape_tells_how_the_pair_runs(pair: dict[SiteId, Daemon]) -> None:
    for site, delay_s in ((LOCAL, 0.05), (REMOTE, 0.03)):
        daemon = pair[site]
        for _ in range(8):  # a crowded machine may need more than one second
            before = daemon.scrape()
            time.sleep(1.0)
            found = daemon.scrape()
            more = {name: value - before[name] for name, value in found.items()}
            ran = more["farhand_ticks_total"]
            assert more["farhand_wakeup_lateness_seconds_count"] == ran
            assert more["farhand_tick_duration_seconds_count"] == ran
            for stage in ("read", "step", "write", "send"):
                assert 0 < more[f"farhand_stage_seconds_count {stage}"] <= ran
                assert more[f"farhand_stage_seconds_sum {stage}"] > 0
            odd = implausible(found, more, delay_s)
            if not odd:
                break
        assert odd == {}
        assert found["farhand_certified_round_trip_seconds"] == pytest.approx(0.3, abs=0.01)
        assert found["farhand_packets_rejected_total session"] == 0
        assert found["farhand_recorder_recording"] == 1
        assert found["farhand_recorder_rows_written_total"] > 100
        assert found["farhand_metrics_rows_lost_total"] == 0


class Prometheus:
    """A server that scrapes daemons every second, with the alerts of the docs."""

    def __init__(self, folder: Path, urls: list[str]) -> None:
        port = free_port()
        self._api = f"http://127.0.0.1:{port}/api/v1"
        targets = [urllib.parse.urlsplit(url).netloc for url in urls]
        rules = re.search(r"```yaml\n(groups:.*?)```", docs("metrics.md"), re.DOTALL)
        assert rules is not None
        (folder / "rules.yml").write_text(rules[1], encoding="utf-8")
        config = {
            "global": {"scrape_interval": "1s", "evaluation_interval": "1s"},
            "rule_files": ["rules.yml"],
            "scrape_configs": [{"job_name": "farhand", "static_configs": [{"targets": targets}]}],
        }
        (folder / "prometheus.yml").write_text(json.dumps(config), encoding="utf-8")  # JSON is YAML
        self.log = folder / "log"
        with self.log.open("wb") as log:
            self._process = subprocess.Popen(
                [
                    shutil.which("prometheus") or "prometheus",
                    f"--config.file={folder / 'prometheus.yml'}",
                    f"--storage.tsdb.path={folder / 'data'}",
                    f"--web.listen-address=127.0.0.1:{port}",
                ],
                stdout=log,
                stderr=log,
            )

    def ask(self, what: str, **parameters: str) -> Any:
        try:
            text = read(f"{self._api}/{what}?{urllib.parse.urlencode(parameters)}")
        except OSError:
            assert self._process.poll() is None, self.log.read_text(encoding="utf-8")
            return {}
        answer = json.loads(text)
        assert answer["status"] == "success"
        return answer["data"]

    def values(self, expression: str) -> list[tuple[dict[str, str], float]]:
        found = self.ask("query", query=expression).get("result", [])
        return [(series["metric"], float(series["value"][1])) for series in found]

    def close(self) -> None:
        self._process.terminate()
        self._process.wait(DEADLINE_S)


def docs(name: str) -> str:
    return (ROOT / "docs" / name).read_text(encoding="utf-8")


def panel_expressions() -> list[tuple[str, str]]:
    dashboard = json.loads(docs("grafana.json"))
    return [
        (panel["title"], target["expr"])
        for panel in dashboard["panels"]
        for target in panel["targets"]
    ]


@pytest.mark.skipif(shutil.which("prometheus") is None, reason="needs the program prometheus")
def test_every_panel_and_every_alert_finds_its_series(
    pair: dict[SiteId, Daemon], tmp_path: Path
) -> None:
    server = Prometheus(tmp_path, [daemon.url for daemon in pair.values()])
    try:
        until(
            # a rate takes two scrapes
            lambda: len(server.values("count_over_time(up[1m]) > 3")) == len(pair),
            lambda: f"scrapes\n{server.log.read_text(encoding='utf-8')}",
        )
        variables = {
            "$session": "metered",
            "$site": "local|remote",
            "$__rate_interval": "10s",
            "$__range": "10s",
        }
        empty = []
        for title, expression in panel_expressions():
            for variable, value in variables.items():
                expression = expression.replace(variable, value)
            assert "$" not in expression
            found = server.values(expression)
            sites = {labels["site"] for labels, value in found if isfinite(value)}
            if sites != {"local", "remote"}:
                empty.append((title, expression, found))
        assert empty == []
        state = server.values('farhand_state{session="metered"} == 1')
        assert {labels["state"] for labels, _ in state} == {"ENGAGED"}
        rules = [r for group in server.ask("rules")["groups"] for r in group["rules"]]
        assert len(rules) == 7
        assert {rule["health"] for rule in rules} == {"ok"}, rules
        firing = {rule["name"] for rule in rules if rule["state"] != "inactive"}
        assert firing <= {"TicksMissed"}  # as a crowded machine may have it
    finally:
        server.close()


def test_the_docs_have_every_metric_and_no_other(pair: dict[SiteId, Daemon]) -> None:
    families = re.findall(r"^# TYPE (\w+) (\w+)$", read(pair[LOCAL].url), re.MULTILINE)
    rows = re.findall(r"^\| `(farhand_\w+)` \| (\w+) \|", docs("metrics.md"), re.MULTILINE)
    table = [
        row for row in rows if not row[0].startswith("farhand_relay_")
    ]  # test_relay.py has them
    assert sorted(families) == sorted(table)
    shown = {
        re.sub("_(bucket|sum|count)$", "", name)
        for _, expression in panel_expressions()
        for name in re.findall(r"farhand_\w+", expression)
    }
    assert shown <= {name for name, _ in table}


def test_a_metrics_process_that_dies_disturbs_nothing_and_is_told(
    pair: dict[SiteId, Daemon],
) -> None:
    """The last one of this pair, which it stops."""
    local, remote = pair[LOCAL], pair[REMOTE]
    before = remote.scrape()
    os.kill(local.metrics_pid(), signal.SIGKILL)
    local.until_said(r"Z local  ENGAGED: no metrics: their process ended with code -9")
    after = remote.scrape()
    assert after["farhand_peer_state ENGAGED"] == 1
    for state in ("HOLD", "FAULT", "READY"):
        entered = f"farhand_state_entries_total {state}"
        assert after[entered] == before[entered]
    assert [local.stop(), remote.stop()] == [0, 0]
    assert "local site" in local.out.read_text(encoding="utf-8")
    for daemon in (local, remote):
        assert re.search(rf"Z {daemon.site.label:6} ENGAGED: both sites agree", daemon.said())
        assert re.search(rf"Z {daemon.site.label:6} \w+: farewell", daemon.said())


@pytest.fixture
def alone(tmp_path: Path) -> Iterator[Callable[..., Daemon]]:
    started: list[Daemon] = []

    def start(*options: str) -> Daemon:
        started.append(Daemon(LOCAL, write_session(tmp_path), *options))
        return started[-1]

    yield start
    for daemon in started:
        daemon.close()


def lines(daemon: Daemon) -> list[dict[str, Any]]:
    def refuse(constant: str) -> None:
        pytest.fail(f"{constant} is no JSON")

    return [json.loads(line, parse_constant=refuse) for line in daemon.said().splitlines()]


def test_a_log_for_programs_is_json_alone(alone: Callable[..., Daemon], tmp_path: Path) -> None:
    daemon = alone("--log", "json", "--quiet")
    daemon.until_said("recording in ")
    time.sleep(0.3)
    daemon.process.send_signal(signal.SIGUSR1)
    daemon.until_said("EMERGENCY_STOP")
    daemon.process.send_signal(signal.SIGUSR2)
    daemon.until_said("reset by the operator")
    assert daemon.stop() == 0
    assert daemon.out.read_text(encoding="utf-8") == ""
    told = lines(daemon)
    session = load_session(tmp_path / "session.toml")
    for line in told:
        assert (line["site"], line["session"]) == ("local", "metered")
        moment = datetime.strptime(line["time"], "%Y-%m-%dT%H:%M:%S.%fZ").replace(tzinfo=UTC)
        assert abs(moment.timestamp() - time.time()) < 60
        assert abs(moment.timestamp() - int(line["epoch"]) * 1e-9) < 60
    assert len({line["epoch"] for line in told}) == 1
    assert f"{session.digest:016x}" in told[0]["text"]
    events = [line for line in told if line["state"] is not None]
    assert [(line["level"], line["state"], line["text"]) for line in events] == [
        ("ERROR", "EMERGENCY_STOP", "the operator of this site stopped it"),
        ("INFO", "READY", "reset by the operator of this site"),
        ("INFO", "READY", "farewell"),
    ]
    # no peer was heard: there is nothing to measure
    assert all(line["round_trip_s"] is None and line["margin_s"] is None for line in events)


def test_what_cannot_start_is_json_too(alone: Callable[..., Daemon]) -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        daemon = alone("--log", "json", "--metrics", str(port))
        assert daemon.process.wait(DEADLINE_S) == 2
    last = lines(daemon)[-1]
    assert last["level"] == "ERROR"
    assert f"metrics cannot be served on 127.0.0.1:{port}: " in last["text"]
    assert "in use" in last["text"]
    # it never recorded: no tick was made, nothing died
    assert not (daemon.err.parent / "state").exists()


def test_metrics_need_no_recorder(alone: Callable[..., Daemon]) -> None:
    daemon = alone("--no-record", "--metrics", "0", "--quiet")
    until(lambda: daemon.scrape()["farhand_ticks_total"] > 10, daemon.said)
    found = daemon.scrape()
    assert found["farhand_recorder_recording"] == 0
    assert found["farhand_state READY"] == 1
    assert found["farhand_peer_state READY"] == 0
    daemon.close()  # as the kernel would, without farewell: its metrics end with it
    until(lambda: not served(daemon.url), lambda: "the end of the metrics")


def served(url: str) -> bool:
    try:
        read(url)
    except OSError:
        return False
    return True


def test_nothing_is_served_unless_asked(alone: Callable[..., Daemon]) -> None:
    daemon = alone("--no-record")
    daemon.until_said("metered")
    time.sleep(0.5)
    assert daemon.stop() == 0
    assert "metrics" not in daemon.said()
