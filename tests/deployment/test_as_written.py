"""docs/deployment.md and the README's "Two machines", done as they are written.

Each machine is a network namespace with a folder of its own, known to the others by the names of
the page. The programs, the certificates, the network and Zenoh are real; `ssh` and `scp` are
stand-ins that work on those folders.
"""

import json
import re
import shutil
import stat
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import rerun_cli
import tomlkit

from site_runtime.supervisor import State
from telemetry.recorded_runs import recorded_runs, recording_files
from tests.deployment.machines import Machine, Machines, Program
from tests.deployment.page import ROOT, Page
from tests.faults import namespace
from tests.loopback.secured import until, write_session

DEPLOYMENT = "docs/deployment.md"
ROUTED = (
    "2. The session",
    "3. Keys, in one command",
    "4. Start",
    "As services",
    "5. Renew, revoke, show",
)
DIRECT = "Without a relay"
# The commands of the page that are not run here, and why.
_FETCHES = "it takes minutes to fetch the packages"
_NO_INIT = "there is no systemd in a namespace; test_deploy_files.py looks at the units"
NOT_RUN = {
    "python3 -m venv /opt/farhand": _FETCHES,
    "/opt/farhand/bin/pip install --require-hashes -r requirements.lock": _FETCHES,
    "/opt/farhand/bin/pip install --no-deps .": _FETCHES,
    "zenohd -c zenohd.json5": "not installed; test_relay.py gives the file to a session of Zenoh's",
    "systemctl enable --now farhand-remote": _NO_INIT,
    "systemctl kill -s SIGUSR1 farhand-remote": _NO_INIT,
}
# Whose keys each machine gets; the page shows the robot's.
PARTIES = {
    "robot": "remote", "hand": "local", "relay": "router", "desk": "desk", "recorder": "recorder",
}  # fmt: skip
# Times of the page that are shortened, and what is added so that the test can look at it.
SHORTER = {"--duration 60": "--duration 2 --rate 200"}
ADDED = {"dashboard": " --save seen.rrd", "doctor": " --seconds 0.3"}
RATE_HZ = 200  # of the loops: five programs and more share the cores of the test's machine
STYLES = 2  # chunks of a line on a dashboard that hears nothing: how it is drawn
RECORDED = 100_000  # bytes of a site's rows: seconds


def _machines(test: Callable[..., None]) -> Callable[..., None]:
    reason = namespace.refusal()
    test = pytest.mark.skipif(reason is not None, reason=str(reason))(test)
    return pytest.mark.patient(test)


@pytest.fixture
def network(tmp_path: Path) -> Iterator[Callable[..., Machines]]:
    made: list[Machines] = []

    def make(*names: str, forwards: bool) -> Machines:
        made.append(Machines(tmp_path / "machines", *names, forwards=forwards))
        return made[-1]

    yield make
    for machines in made:
        machines.close()


def left(page: Page) -> list[str]:
    """The commands that are neither run by now nor named in NOT_RUN."""
    return [command.text for command in page.left if command.text not in NOT_RUN]


def write(file: Path, page: Page) -> None:
    """The demo's arms in free motion, with the page's tables in place of their own."""
    write_session(file, Path("keys"))
    document = tomlkit.parse(file.read_text(encoding="utf-8")).unwrap()
    document |= {"name": "demo", "loop": {"rate_hz": RATE_HZ}}
    document["channel"] |= page.settings.get("channel", {})
    document["network"] = page.settings["network"]
    file.write_text(tomlkit.dumps(document), encoding="utf-8")


def copied(machines: Machines, page: Page, parties: dict[str, str]) -> None:
    """Copy session and keys to each machine by the commands that the page has for the robot."""
    commands = [page.take(name) for name in ("ssh", "scp", "scp")]
    for machine, party in parties.items():
        for command in commands:
            text = command.text.replace("robot", machine).replace("remote", party)
            machines["office"].run(text)
        place = machines[machine].folder / "keys" / party
        assert stat.S_IMODE(place.stat().st_mode) == 0o700
        assert {stat.S_IMODE(file.stat().st_mode) for file in place.iterdir()} == {0o600}
        assert [other.name for other in place.parent.iterdir()] == [party]


def start(machines: Machines, page: Page, *words: str) -> Program:
    """Start the page's next command with these words, on the machine that its comment names."""
    command = page.take("farhand", *words)
    return machines[command.machine].start(command.text + ADDED.get(words[0], ""))


def said(program: Program, *words: str) -> None:
    """Wait until a program has said all these words."""
    until(lambda: program.process.poll() is not None or has(program, *words), f"said: {words}")
    assert has(program, *words), program.text()


def has(program: Program, *words: str) -> bool:
    text = program.text()
    return all(word in text for word in words)


def engaged(*sites: Program, word: str = "ENGAGED: ") -> None:
    for site in sites:
        said(site, word)


def as_a_service(machine: Machine, unit: str) -> Program:
    """Start what a unit in deploy/ starts."""
    text = (ROOT / "deploy" / f"farhand-{unit}.service").read_text(encoding="utf-8")
    (command,) = re.findall(r"^ExecStart=/opt/farhand/bin/(.*)$", text, re.MULTILINE)
    return machine.start(command.replace("/etc/farhand", str(machine.folder)))


def shows_both(desk: Machine) -> bool:
    """Whether the desk's dashboard has been told torques of both sites by now."""
    tool = Path(rerun_cli.__file__).with_name("rerun")
    command = [tool, "rrd", "stats", "--continue-on-error", desk.folder / "seen.rrd"]
    stats = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60).stdout
    chunks = dict(re.findall(r"^/torque/(\w+): (\d+)$", stats, re.MULTILINE))
    return all(int(chunks.get(site, 0)) > STYLES for site in ("local", "remote"))


def seconds_of_both(recording: Path) -> bool:
    sizes = [file.stat().st_size for file in recording.glob("*.mcap")]
    return len(sizes) == 2 and min(sizes) > RECORDED


def told_history(machines: Machines, play: Callable[[], None]) -> None:
    try:
        play()
    except (AssertionError, subprocess.TimeoutExpired) as error:
        raise AssertionError(f"{error}\n{machines.history()}") from error


def test_every_command_of_the_page_is_run_or_named_with_a_reason() -> None:
    """Of a played section `left` sees to it at the end."""
    page = Page(DEPLOYMENT)
    played = [command.text for command in Page(DEPLOYMENT, *ROUTED, DIRECT).left]
    assert [text for text in left(page) if text not in played] == []
    assert set(NOT_RUN) <= {command.text for command in page.left}


@_machines
def test_from_bare_machines_through_a_relay(network: Callable[..., Machines]) -> None:
    machines = network(*("relay", "hand", "robot", "desk", "recorder", "thief"), forwards=False)
    told_history(machines, lambda: through_a_relay(machines))


def through_a_relay(machines: Machines) -> None:
    page = Page(DEPLOYMENT, *ROUTED)
    office, relay, robot = machines["office"], machines["relay"], machines["robot"]
    assert machines.reaches("hand", "relay")
    assert not machines.reaches("hand", "robot")

    write(office.folder / "session.toml", page)
    office.run(page.take("farhand", "keys", "session.toml").text)
    copied(machines, page, PARTIES)

    router = start(machines, page, "router")
    answer = start(machines, page, "link-test", "session.toml", "--answer")
    said(answer, "answering")
    measure = page.take("farhand", "link-test")
    text = measure.text
    for long, short in SHORTER.items():
        assert long in text
        text = text.replace(long, short)
    # 1: on a busy machine the certificate may not cover what was measured
    assert "profile that fits" in machines[measure.machine].run(text, allowed=(0, 1))
    assert answer.interrupt() == 0

    remote, local = start(machines, page, "remote"), start(machines, page, "local")
    dashboard, recorder = start(machines, page, "dashboard"), start(machines, page, "record")
    engaged(remote, local)
    said(dashboard, "dashboard: http")
    for line in page.printed:
        # any number of packets, between any two of the packets' statements
        wanted = re.sub(r"\d+(?= packets)", r"\\d+", re.escape(line).replace(r"\ ", " "))
        until(lambda wanted=wanted: bool(re.search(wanted, router.text())), f"the relay: {line}")

    recording = machines["recorder"].folder / "try-1"
    until(lambda: seconds_of_both(recording), "rows of both sites")
    until(lambda: shows_both(machines["desk"]), "both sites on the dashboard")
    assert recorder.interrupt() == 0
    runs = {run.metadata["site"]: run
            for run in recorded_runs(recording_files([recording]))}  # fmt: skip
    assert set(runs) == {"local", "remote"}
    for run in runs.values():
        assert run.complete
        assert run.gaps == ()
        assert len(run.rows) > RATE_HZ
        assert run.rows["state"][-1] == State.ENGAGED
    assert dashboard.interrupt() == 0
    assert [site.interrupt() for site in (local, remote, router)] == [0, 0, 0]

    certificates = office.run(page.take("farhand", "keys", "show").text)
    for name in ("remote-1", "local-1", "router-1", "observer.desk-1", "observer.recorder-1"):
        assert re.search(rf"^{re.escape(name)}: \d+ days left", certificates, re.MULTILINE)
    assert "remote-1" in office.run(page.take("farhand", "keys", "renew").text)
    assert "remote-1 is revoked" in office.run(page.take("farhand", "keys", "revoke").text)
    assert "remote-2" in office.run(page.take("farhand", "keys", "renew").text)
    thief = machines["thief"]
    shutil.copytree(robot.folder, thief.folder)
    while any(command.text.startswith("scp") for command in page.left):
        office.run(page.take("scp").text)

    router, local = as_a_service(relay, "router"), as_a_service(machines["hand"], "local")
    stolen = thief.start("farhand remote session.toml")
    said(router, "local-1 connected", "remote-1 connected")
    remote = as_a_service(robot, "remote")
    said(router, "remote-2 connected")
    engaged(remote, local, word='"state": "ENGAGED"')
    assert stolen.interrupt() == 0
    assert "ENGAGED" not in stolen.text()
    assert "; 0 received" in stolen.text()
    assert [site.interrupt() for site in (local, remote, router)] == [0, 0, 0]

    relay.run(page.take("farhand", "router", "session.toml", "--print-config").text)
    assert json.loads((relay.folder / "zenohd.json5").read_text("utf-8"))["mode"] == "router"
    assert left(page) == []


@_machines
def test_from_bare_machines_without_a_relay(network: Callable[..., Machines]) -> None:
    machines = network("network", "hand", "robot", "desk", forwards=True)
    told_history(machines, lambda: without_a_relay(machines))


def without_a_relay(machines: Machines) -> None:
    page = Page(DEPLOYMENT, DIRECT)
    assert machines.reaches("hand", "robot")
    office = machines["office"]
    write(office.folder / "session.toml", page)
    office.run(page.take("farhand", "keys").text)
    parties = {"robot": "remote", "hand": "local", "desk": "dashboard"}
    copied(machines, Page(DEPLOYMENT, "3. Keys, in one command"), parties)
    remote, local = start(machines, page, "remote"), start(machines, page, "local")
    dashboard = start(machines, page, "dashboard")
    engaged(remote, local)
    said(dashboard, "dashboard: http")
    page_is_done(page, machines["desk"], dashboard, local, remote)


def page_is_done(page: Page, desk: Machine, dashboard: Program, *sites: Program) -> None:
    """The dashboard shows both sites, all end well, and no command is left."""
    until(lambda: shows_both(desk), "both sites on the dashboard")
    assert dashboard.interrupt() == 0
    assert [site.interrupt() for site in sites] == [0] * len(sites)
    assert left(page) == []


@_machines
def test_the_readme_s_two_machines(network: Callable[..., Machines]) -> None:
    machines = network("network", "A", "B", forwards=True)
    told_history(machines, lambda: two_machines(machines))


def two_machines(machines: Machines) -> None:
    page = Page("README.md", "Two machines")
    a, b = machines["A"], machines["B"]
    a.folder.mkdir()
    write(a.folder / "SESSION.toml", page)
    start(machines, page, "keys").process.wait()
    b.folder.mkdir()
    shutil.copy(a.folder / "SESSION.toml", b.folder)
    shutil.copytree(a.folder / "keys" / "remote", b.folder / "keys" / "remote")
    for doctor in [start(machines, page, "doctor") for _ in range(2)]:
        assert doctor.process.wait(60) in (0, 1)  # 1: a busy machine cannot hold the rate
        said(doctor, "tick")
    remote, local = start(machines, page, "remote"), start(machines, page, "local")
    dashboard = start(machines, page, "dashboard")
    engaged(remote, local)
    page_is_done(page, a, dashboard, local, remote)
