"""Machines, each a network namespace with a folder for its files, around one that all reach.

python -m tests.deployment.machines FORWARDS NAME... makes them, and removes them, with what still
runs there, when its stdin ends.
"""

import itertools
import os
import signal
import socket
import subprocess
import sys
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Self

from tests.faults import namespace
from tests.faults.companion import ROOT, Companion

END_S = 30.0
COMMAND_S = 60.0
_numbers = itertools.count()
# What stands in for a copy to, and a command on, another machine: their folders are all here.
_STAND_INS = {
    "farhand": f"""#!{sys.executable}
from farhand.__main__ import main

raise SystemExit(main())
""",
    "ssh": """#!/bin/bash
machine=$1; shift
exec "${@/#\\/etc\\//$MACHINES/$machine/etc/}"
""",
    "scp": """#!/bin/bash
to=${!#}
exec cp "${@:1:$#-1}" "$MACHINES/${to%%:*}${to#*:}"
""",
}


@dataclass
class Program:
    """A command that runs, as in a terminal of its own."""

    process: subprocess.Popen[bytes]
    log: Path

    def text(self) -> str:
        """What it has said."""
        return self.log.read_text(encoding="utf-8")

    def interrupt(self) -> int:
        """Ctrl-C; return the exit code."""
        with suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGINT)
        return self.process.wait(END_S)


@dataclass
class Machine:
    """One machine: its files are below `place`; without a namespace it only keeps files."""

    name: str
    place: Path
    namespace: str | None
    programs: list[Program] = field(default_factory=list)

    @property
    def folder(self) -> Path:
        """Where its session file and keys are."""
        return self.place / "etc" / "farhand"

    def start(self, command: str) -> Program:
        """Start a command in its folder."""
        log = self.place / f"{len(self.programs)}.log"
        with log.open("wb") as said:
            process = subprocess.Popen(
                self._enter(command),
                cwd=self.folder,
                env=self._environment(),
                stdin=subprocess.DEVNULL,
                stdout=said,
                stderr=said,
                start_new_session=True,
            )
        program = Program(process, log)
        self.programs.append(program)
        return program

    def run(self, command: str, allowed: tuple[int, ...] = (0,)) -> str:
        """Run a command in its folder to its end; return what it says."""
        program = self.start(command)
        code = program.process.wait(COMMAND_S)
        assert code in allowed, f"{self.name}: {command}: exit code {code}\n{program.text()}"
        return program.text()

    def _enter(self, command: str) -> list[str]:
        shell = ["bash", "-c", command]
        if self.namespace is None:
            return shell
        named = 'mount --bind "$0" /etc/hosts && exec ip netns exec "$@"'
        hosts = str(self.place.parent / "hosts")
        own = ["unshare", "--mount", "--propagation", "private", "sh", "-c", named, hosts]
        return [*own, self.namespace, *shell]

    def _environment(self) -> dict[str, str]:
        machines = self.place.parent
        environment = {k: v for k, v in os.environ.items() if "DISPLAY" not in k}
        return environment | {
            "PATH": f"{machines / 'bin'}:{os.environ['PATH']}",
            "PYTHONPATH": str(ROOT),
            "MACHINES": str(machines),
            "XDG_STATE_HOME": str(self.place / "state"),
            "COLUMNS": "200",
        }


class Machines:
    """The machines by name. `forwards`: the first lets the others reach each other through it."""

    def __init__(self, folder: Path, *names: str, forwards: bool, offline: str = "office") -> None:
        self._folder = folder
        run = f"farhand-{os.getpid()}-{next(_numbers)}"
        spaces = {name: f"{run}-{name}" for name in names}
        self._keeper = Companion(
            [sys.executable, "-m", "tests.deployment.machines", f"{forwards:d}", *spaces.values()]
        )
        self._machines = {
            name: Machine(name, folder / name, spaces.get(name)) for name in (*names, offline)
        }
        for machine in self._machines.values():
            machine.folder.parent.mkdir(parents=True)
        self._machines[offline].folder.mkdir()
        (folder / "bin").mkdir()
        for name, text in _STAND_INS.items():
            (folder / "bin" / name).write_text(text, encoding="utf-8")
            (folder / "bin" / name).chmod(0o755)
        hosts = [f"{address(k)} {name} {name}.example" for k, name in enumerate(names)]
        (folder / "hosts").write_text("\n".join(("127.0.0.1 localhost", *hosts, "")), "utf-8")
        self._addresses = {name: address(k) for k, name in enumerate(names)}

    def __getitem__(self, name: str) -> Machine:
        return self._machines[name]

    def reaches(self, one: str, other: str) -> bool:
        """Whether a TCP connection from one machine to another comes about."""
        with namespace.inside(str(self[other].namespace)):
            server = socket.create_server((self._addresses[other], 0))
        with server, namespace.inside(str(self[one].namespace)), socket.socket() as client:
            client.settimeout(1.0)
            return client.connect_ex(server.getsockname()) == 0

    def history(self) -> str:
        """What all programs said, for failures."""
        logs = sorted(self._folder.glob("*/*.log"))
        return "\n".join(f"{log.parent.name}/{log.name}: {log.read_text('utf-8')}" for log in logs)

    def close(self) -> None:
        """End what runs on them, and remove them."""
        for machine in self._machines.values():
            for program in machine.programs:
                with suppress(ProcessLookupError):
                    os.killpg(program.process.pid, signal.SIGKILL)
                program.process.wait()
        self._keeper.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


def address(number: int) -> str:
    """Return the address of a machine; number 0 is the one in the middle."""
    return f"10.214.{number}.2"


def _make(middle: str, others: list[str], forwards: bool) -> None:
    namespace.ip("-n", middle, "address", "add", f"{address(0)}/32", "dev", "lo")
    with namespace.inside(middle):
        Path("/proc/sys/net/ipv4/ip_forward").write_text(f"{forwards:d}", encoding="ascii")
    for number, name in enumerate(others, 1):
        near, gateway = f"to{number}", f"10.214.{number}.1"
        namespace.ip(
            *("link", "add", near, "netns", middle, "type", "veth"),
            *("peer", "name", "eth0", "netns", name),
        )
        for space, device, own in ((middle, near, gateway), (name, "eth0", address(number))):
            namespace.ip("-n", space, "address", "add", f"{own}/24", "dev", device)
            namespace.ip("-n", space, "link", "set", device, "up")
        namespace.ip("-n", name, "route", "add", "default", "via", gateway)


def _remove(name: str) -> None:
    pids = subprocess.run(
        ["ip", "netns", "pids", name],  # noqa: S607
        capture_output=True,
        text=True,
        check=False,
    ).stdout
    for pid in pids.split():
        with suppress(ProcessLookupError):
            os.kill(int(pid), signal.SIGKILL)
    namespace.delete(name)


def main(forwards: bool, names: list[str]) -> None:
    """Make the namespaces; keep them until stdin ends; end what runs there, and remove them."""
    made: list[str] = []
    try:
        for name in names:
            namespace.create(name)
            made.append(name)
        _make(names[0], names[1:], forwards)
        sys.stdout.write("ready\n")
        sys.stdout.flush()
        sys.stdin.read()
    finally:
        for name in made:
            _remove(name)


if __name__ == "__main__":
    main(sys.argv[1] == "1", sys.argv[2:])
