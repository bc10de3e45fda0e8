"""Two network namespaces and the bad network between them, changeable while it runs."""

import itertools
import json
import os
import socket
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Self

from tests.faults import namespace
from tests.faults.companion import Companion
from tests.faults.packet_queue import ADDRESSES, Impairment, order

__all__ = ["BOTH_WAYS", "CLEAR", "ImpairedNetwork", "Impairment"]

BOTH_WAYS = (0, 1)
CLEAR = Impairment()
_numbers = itertools.count()


class ImpairedNetwork:
    """Sides 0 and 1, a namespace each, joined by a wire that delays, loses, reorders, doubles.

    The wire is a process of its own: it removes the namespaces when it is left, or when this
    process ends in any way. Impairments are per direction, named by the side that they come from.
    """

    def __init__(self, seed: int = 1) -> None:
        """Make it; OSError if the machine refuses (`namespace.refusal` says why)."""
        run = f"{os.getpid()}-{next(_numbers)}"
        self.names = (f"farhand-{run}-a", f"farhand-{run}-b")
        self.dropped = [0, 0]
        self._wire = Companion(
            [sys.executable, "-m", "tests.faults.packet_queue", *self.names, str(seed)]
        )

    def address(self, side: int) -> str:
        """IP address of a side."""
        return ADDRESSES[side]

    def impair(self, impairment: Impairment, sources: Sequence[int] = BOTH_WAYS) -> int:
        """Treat packets from these sides so from now on; return since when [ns, monotonic]."""
        answer = json.loads(self._wire.ask(order(tuple(sources), impairment)))
        self.dropped = answer["dropped"]
        return int(answer["since_ns"])

    def command(self, side: int, command: Sequence[str]) -> list[str]:
        """Return the command that runs `command` on a side; it keeps its process id."""
        return ["ip", "netns", "exec", self.names[side], *command]

    def datagram_socket(self, side: int) -> socket.socket:
        """Return an unbound UDP socket on a side."""
        with namespace.inside(self.names[side]):
            return socket.socket(socket.AF_INET, socket.SOCK_DGRAM)

    def processor_s(self) -> float:
        """Processor time that the wire has used so far [s]."""
        fields = Path(f"/proc/{self._wire.pid}/stat").read_text(encoding="ascii").split()
        return (int(fields[13]) + int(fields[14])) / os.sysconf("SC_CLK_TCK")

    def close(self) -> None:
        """Remove it. Idempotent, never raises."""
        self._wire.close()
        for name in self.names:
            if (Path("/run/netns") / name).exists():
                namespace.delete(name)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


def flap(network: ImpairedNetwork, period_s: float, duration_s: float) -> int:
    """Cut and restore the link in turns, each `period_s`; return when it was first cut [ns]."""
    since_ns = network.impair(Impairment(blackout=True))
    end_ns = since_ns + round(duration_s * 1e9)
    for cut in itertools.cycle((False, True)):
        time.sleep(period_s)
        if time.monotonic_ns() >= end_ns:
            break
        network.impair(Impairment(blackout=cut))
    network.impair(CLEAR)
    return since_ns
