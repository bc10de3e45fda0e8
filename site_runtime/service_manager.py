"""What systemd is told of this process: that it is ready, that its loop goes on, that it ends."""

import os
import socket
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Final

from site_runtime.daemon_log import DaemonLog
from site_runtime.keeper import Keeper

_LOOK_S: Final = 0.5  # without a watchdog


class ServiceManager:
    """Datagrams to the socket that `NOTIFY_SOCKET` names; where it names none, nothing happens."""

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        """Read the environment: the socket, and the watchdog if it is meant for this process."""
        named = environment.get("NOTIFY_SOCKET", "")
        self._address = f"\0{named[1:]}" if named.startswith("@") else named
        self._socket: socket.socket | None = None
        if named.startswith(("/", "@")):
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
            self._socket.setblocking(False)
        watched = environment.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        limit_us = environment.get("WATCHDOG_USEC", "") if watched else ""
        self.watchdog_s: float | None = int(limit_us) * 1e-6 if limit_us.isdecimal() else None
        """After so long without `alive` it kills this process; None: it does not watch."""

    @property
    def listens(self) -> bool:
        """Whether there is one to tell."""
        return self._socket is not None

    def ready(self) -> None:
        """Tell that the start has succeeded. Like the others: never blocks, never raises."""
        self._tell(b"READY=1")

    def alive(self) -> None:
        """Tell that all goes on, for the watchdog."""
        self._tell(b"WATCHDOG=1")

    def stopping(self) -> None:
        """Tell that this process is about to end."""
        self._tell(b"STOPPING=1")

    def close(self) -> None:
        """Close the socket. Idempotent."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _tell(self, what: bytes) -> None:
        if self._socket is not None:
            with suppress(OSError):  # it is gone, or does not read
                self._socket.sendto(what, self._address)


class ServiceKeeper(Keeper):
    """Tells the manager of a loop as long as its `ticks` advance, from a thread of its own.

    A thread that only lives would hide a loop that stands still. Ready is a loop that ticked once.
    """

    def __init__(self, manager: ServiceManager, ticks: Callable[[], int], log: DaemonLog) -> None:
        limit_s = manager.watchdog_s
        period_s = _LOOK_S if limit_s is None else min(limit_s / 4.0, _LOOK_S)
        super().__init__("service", period_s, log)
        self._manager = manager
        self._ticks = ticks
        self._seen = ticks()
        self._ready = False

    def look(self) -> None:
        """Tell, if the loop has ticked since the last look."""
        ticks = self._ticks()
        if ticks == self._seen:
            return
        self._seen = ticks
        if not self._ready:
            self._ready = True
            self._manager.ready()
        self._manager.alive()

    def look_failed(self) -> None:
        """Say nothing: a watchdog that hears nothing acts."""

    def ended(self) -> None:
        """Tell that the process is about to end."""
        self._manager.stopping()
