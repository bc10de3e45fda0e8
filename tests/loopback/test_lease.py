"""One robot, three people with certificates, a relay or none: who drives, who is told what."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from channel.zenoh_link import ZenohNode, ZenohSettings
from site_runtime.keys import SiteId, claim_key, state_key
from site_runtime.lease import Verb, Wish
from site_runtime.lease_messages import RemoteStatus, decode_status, encode_wish
from site_runtime.link_keeper import ASK_S, UNHEARD_S
from site_runtime.security.identity import Identity
from telemetry.recorded_runs import recorded_runs, recording_files
from tests.loopback.remote_that_fails import FAIL
from tests.loopback.secured import (
    NAME,
    ORPHAN_S,
    ROOT,
    make_keys,
    tls,
    until,
    write_session,
)
from tests.ports import free_port

pytestmark = pytest.mark.patient
PARTIES = tuple(
    Identity(name)
    for name in (
        "remote",
        "router",
        "dashboard",
        "operator.alice",
        "operator.bob",
        "supervisor.carol",
    )
)
SILENCE_S = 2.0


class Robot:
    """A remote site that records, its relay, operators' local sites, and what `list` says."""

    def __init__(self, folder: Path, *, routed: bool, **packets: object) -> None:
        self.folder = folder
        self.keys = folder / "keys"
        make_keys(self.keys, PARTIES)
        self.routed = routed
        self.place = f"tls/127.0.0.1:{free_port()}"  # where all meet: the relay, or the robot
        network = {"router": self.place}
        if not routed:
            network = {
                "remote_listen": self.place,
                "local_connect": self.place,
                "local_listen": f"tls/127.0.0.1:{free_port()}",
            }
        self.file = write_session(
            folder / "session.toml",
            self.keys,
            operator_silence_s=SILENCE_S,
            **network,
            **packets,
        )
        text = self.file.read_text(encoding="utf-8")
        self.file.write_text(
            f'{text}\n[recorder]\ndirectory = "{folder / "recorded"}"\n', encoding="utf-8"
        )
        self.processes: dict[str, subprocess.Popen[bytes]] = {}

    def start(self, name: str, *command: str) -> None:
        with (self.folder / f"{name}.log").open("ab") as log:
            self.processes[name] = subprocess.Popen(
                [sys.executable, "-m", *command, "--duration", str(ORPHAN_S)],
                cwd=ROOT,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
            )

    def start_operator(self, name: str) -> None:
        # each on a machine of his own else, where he listens for dashboards
        own = () if self.routed else ("--listen", f"tls/127.0.0.1:{free_port()}")
        self.start(name, "local_site", str(self.file), "--as", name, "--no-record", *own)

    def end(self, name: str, number: int = signal.SIGINT) -> None:
        process = self.processes.pop(name)
        process.send_signal(signal.SIGCONT)
        process.send_signal(number)
        process.wait(30)

    def farhand(self, *words: str) -> tuple[int, str]:
        done = subprocess.run(
            [sys.executable, "-m", "farhand", *words],
            cwd=ROOT,
            env=os.environ,
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )
        return done.returncode, done.stdout + done.stderr

    def text(self, name: str) -> str:
        return (self.folder / f"{name}.log").read_text(encoding="utf-8")

    def close(self) -> None:
        for name in list(self.processes):
            self.end(name, signal.SIGKILL)


class Ear:
    """Hears the remote site as an observer."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._node = behind(robot, "dashboard", "observer")
        self._ear = self._node.subscriber(f"farhand/{NAME}/remote/lease", 100)
        self.status: RemoteStatus | None = None

    def update(self) -> None:
        for _, payload in self._ear.receive():
            self.status = decode_status(payload) or self.status

    def newest(self) -> RemoteStatus:
        self.update()
        assert self.status is not None
        return self.status

    def answered(self, name: str) -> tuple[str, bool, str] | None:
        answer = self.newest().answers.get(name)
        return None if answer is None else (answer.epoch, answer.granted, answer.text)

    def until(self, holder: str | None, state: str, within_s: float = 60.0) -> None:
        def reached() -> bool:
            self.update()
            status = self.status
            return status is not None and (status.holder, status.state) == (holder, state)

        try:
            until(reached, f"{holder} and {state}", within_s)
        except AssertionError as error:
            logs = "".join(
                f"\n== {log.name}\n{log.read_text(encoding='utf-8')[-3000:]}"
                for log in sorted(self._robot.folder.glob("*.log"))
            )
            raise AssertionError(f"{error}: {self.status}{logs}") from None

    def close(self) -> None:
        self._node.close()


@pytest.fixture(params=[True, False], ids=["router", "no router"])
def robot(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Robot]:
    with closing(Robot(tmp_path, routed=request.param)) as robot:
        if robot.routed:
            robot.start("router", "farhand", "router", str(robot.file))
        robot.start("remote", "remote_site", str(robot.file))
        yield robot


def behind(robot: Robot, identity: str, region: str = "local") -> ZenohNode:
    """A node at the relay, or dialling the robot, that enforces nothing itself."""
    configuration = tls(robot.keys / identity)
    if robot.routed:
        configuration["region_name"] = region
    return ZenohNode(ZenohSettings(connect=(robot.place,), configuration=configuration))


def events(robot: Robot) -> list[str]:
    """What the remote's recording tells of the lease."""
    runs = recorded_runs(recording_files([robot.folder / "recorded"]))
    return [
        event.text.removeprefix("lease: ")
        for run in runs
        for event in run.events
        if event.text.startswith("lease: ")
    ]


def test_one_holds_it_and_it_goes_from_hand_to_hand_only_by_right(robot: Robot) -> None:
    session = str(robot.file)
    with closing(Ear(robot)) as ear:
        robot.start_operator("alice")
        ear.until("alice", "ENGAGED")

        # a second one is refused, and told by whom
        robot.start_operator("bob")
        until(lambda: "refused, alice holds it" in robot.text("bob"), "bob told")
        code, listed = robot.farhand("list", session, "--json", "--wait", "2")
        (shown,) = json.loads(listed)
        assert code == 0
        assert (shown["session"], shown["state"], shown["dimension"]) == (NAME, "ENGAGED", 2)
        assert (shown["holder"], shown["refused"]) == ("alice", {"bob": "alice holds it"})
        assert shown["held_s"] > 0
        assert 0 < shown["round_trip_s"] < 5

        # words in another's name, and poses in one's own, do nothing
        with closing(behind(robot, "operator.bob")) as thief:
            partner = "router-1" if robot.routed else "remote-1"
            until(lambda: thief.partners() == (partner,), "a connection")
            claims = thief.publisher(claim_key(NAME, "alice"))
            poses = thief.publisher(state_key(NAME, SiteId.LOCAL, "alice"))
            own = thief.publisher(claim_key(NAME, "bob"))
            for _ in range(20):
                claims(encode_wish(Wish(Verb.GIVE, time.time_ns(), "bob")))
                claims(encode_wish(Wish(Verb.RELEASE, time.time_ns())))
                poses(b"forged")
                time.sleep(0.02)
            assert "bob" not in ear.newest().answers

            # nor does what is not one's right; this too is what the claims above did not reach
            for verb, text in (
                (Verb.TAKE, "only a supervisor may take it"),
                (Verb.GIVE, "you do not hold it"),
            ):
                wish = Wish(verb, time.time_ns(), "bob")
                until(
                    lambda wish=wish, text=text: (
                        own(encode_wish(wish)),
                        ear.answered("bob") == (str(wish.epoch), False, text),
                    )[1],
                    f"an answer to {verb}",
                )
        ear.until("alice", "ENGAGED")
        assert "alice" not in ear.newest().answers

        # given by the holder
        assert robot.farhand("lease", "give", session, "bob", "--as", "alice") == (
            0,
            "given to bob\n",
        )
        ear.until("bob", "ENGAGED")
        until(lambda: "refused, bob holds it" in robot.text("alice"), "alice told")

        # taken by a supervisor
        robot.start_operator("carol")
        until(lambda: "refused, bob holds it" in robot.text("carol"), "carol told")
        assert robot.farhand("lease", "take", session, "--as", "carol") == (0, "taken\n")
        ear.until("carol", "ENGAGED")

        # left by its holder: to who has waited longest
        robot.end("carol")
        ear.until("alice", "ENGAGED")

        # silent
        robot.processes["alice"].send_signal(signal.SIGSTOP)
        ear.until("bob", "ENGAGED")
        robot.end("alice", signal.SIGKILL)
        robot.end("bob")
        ear.until(None, "READY")
        time.sleep(2.5 * (UNHEARD_S + ASK_S))
        # nobody to hear is no reason to leave the network
        assert "the connection is opened anew" not in robot.text("remote")
    robot.end("remote")
    told = events(robot)
    expected = [
        "alice claims it",
        "alice holds it",
        "bob is refused: alice holds it",
        "bob may not take it: no supervisor",
        "bob may not give it to bob: you do not hold it",
        "alice gives it to bob",
        "bob holds it",
        "carol is refused: bob holds it",
        "carol takes it from bob",
        "carol holds it",
        "carol releases it",
        "alice holds it",
    ]
    assert told[: len(expected)] == expected
    assert told[len(expected)].startswith("expired: nothing of alice for")
    assert told[len(expected) + 1 :] == ["bob holds it", "bob releases it"]
    log = robot.text("remote")
    for line in expected:
        assert f"lease: {line}" in log
    # between two holders the outputs were off
    states = [line.partition("remote ")[2] for line in log.splitlines() if " remote " in line]
    for i, line in enumerate(states):
        if "holds it" in line and "refused" not in line and "gives" not in line:
            assert "READY" in line, (i, states)


def _ready(text: str) -> int:
    return text.count("READY: the lease is over") + text.count("READY: nobody here")


def test_a_lease_that_cannot_be_kept_is_told_and_ended_and_goes_on(tmp_path: Path) -> None:
    """The safe side of a surprise: outputs off, then whoever claims it, by the usual way."""
    with closing(Robot(tmp_path, routed=False)) as robot:
        robot.start("remote", "tests.loopback.remote_that_fails", str(robot.file))
        with closing(Ear(robot)) as ear, closing(behind(robot, "operator.alice")) as words:
            robot.start_operator("alice")
            say = words.publisher(claim_key(NAME, "alice"))
            for times in range(1, 3):
                ear.until("alice", "ENGAGED")

                def ended(times: int = times) -> bool:
                    say(FAIL)  # again: what is published may be lost
                    time.sleep(0.5)
                    return robot.text("remote").count("lease: alice loses it") >= times

                until(ended, "the lease ended")
            until(lambda: _ready(robot.text("remote")) >= 2, "the outputs went off each time")
            ear.until("alice", "ENGAGED")
        text = robot.text("remote")
    assert text.count("keeping the lease failed, and goes on: RuntimeError: words") == 1
