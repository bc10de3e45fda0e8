"""Both daemons of the demo as processes of their own, and what their telemetry says."""

import signal
import socket
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from types import TracebackType
from typing import Self

import numpy as np

from channel.zenoh_link import ZenohNode, ZenohSettings
from experiments.benchmarks.figures import BenchmarkError
from site_runtime.keys import SiteId, telemetry_key
from site_runtime.session_edit import TomlValue, edited
from site_runtime.supervisor import State
from telemetry.rows import RowArray, TelemetryError
from telemetry.stream import decode_batch

DEMO = Path(__file__).resolve().parents[1] / "demo.toml"
NO_DELAY: Mapping[str, TomlValue | None] = {
    "channel.injection": "off",
    "channel.local_to_remote": None,
    "channel.remote_to_local": None,
}
LONGEST_S = 1800.0
"""After which a daemon ends by itself, should whoever started it be killed."""

_PATIENCE_S = 30.0
_STEADY_S = 0.5  # under full force
_POLL_S = 0.25
_BATCHES = 4000
_BATCH_S = 0.3
_END_S = 10.0


class Sites:
    """The demo's two daemons on this machine, changed as asked; within `with` they run.

    They record into a folder that is deleted at the end, unless `options` say otherwise.
    `router` is an endpoint to meet at.
    """

    def __init__(
        self,
        name: str,
        changes: Mapping[str, TomlValue | None] | None = None,
        *,
        options: Sequence[str] = (),
        router: str | None = None,
    ) -> None:
        self._name = name
        self._changes = dict(changes or {})
        self._options = tuple(options)
        self._router = router
        self._endpoints = {site: free_endpoint() for site in SiteId}
        self._processes: dict[SiteId, subprocess.Popen[bytes]] = {}

    def __enter__(self) -> Self:
        self._folder = TemporaryDirectory(prefix="farhand-bench-")
        try:
            for site in (SiteId.REMOTE, SiteId.LOCAL):
                self._processes[site] = self._start(site)
            self._node = ZenohNode(ZenohSettings(connect=tuple(self._endpoints.values())))
            self._telemetry = {
                site: self._node.subscriber(telemetry_key(self._name, site), _BATCHES)
                for site in SiteId
            }
        except BaseException:
            self._end()
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._node.close()
        self._end()

    def pid(self, site: SiteId) -> int:
        """Process id of a site's daemon."""
        return self._processes[site].pid

    def hear(self, seconds: float) -> dict[SiteId, RowArray]:
        """Return the rows of the next so many seconds."""
        start_ns = time.monotonic_ns()
        end_s = time.monotonic() + seconds
        while (left_s := end_s - time.monotonic()) > 0.0:
            time.sleep(min(left_s, _POLL_S))
            self.check_alive()
        return self.heard_since(start_ns)

    def heard_since(self, start_ns: int) -> dict[SiteId, RowArray]:
        """Return the rows, of ticks from then on [ns], that came since last asked.

        BenchmarkError if a site has ended or is mute. The telemetry of some 100 s at 1 kHz is kept.
        """
        time.sleep(_BATCH_S)  # the last batch is still being filled
        found = {}
        for site, batches in self._collect().items():
            rows = [batch[batch["stamp_ns"] >= start_ns] for batch in batches]
            if not any(map(len, rows)):
                raise BenchmarkError(f"the {site.label} site tells nothing")
            found[site] = np.concatenate(rows)
        return found

    def check_alive(self) -> None:
        """Raise BenchmarkError with its last words if a site has ended."""
        for site, process in self._processes.items():
            if process.poll() is not None:
                log = self._log(site).read_text(encoding="utf-8", errors="replace").strip()
                raise BenchmarkError(f"the {site.label} site ended by itself: {log[-300:]}")

    def until_heard(self, patience_s: float = _PATIENCE_S) -> None:
        """Wait until both have told something; BenchmarkError if that takes longer."""
        end_s = time.monotonic() + patience_s
        mute = set(SiteId)
        while mute:
            if time.monotonic() > end_s:
                told = " and ".join(site.label for site in mute)
                raise BenchmarkError(f"not heard within {patience_s:.0f} s: {told}")
            time.sleep(_POLL_S)
            mute -= {site for site, batches in self._collect().items() if batches}

    def until_engaged(self, patience_s: float = _PATIENCE_S) -> None:
        """Wait until both have had full force for a while; BenchmarkError if that takes longer."""
        end_s = time.monotonic() + patience_s
        since_s: dict[SiteId, float] = {}
        states: dict[SiteId, str] = {}
        while len(since_s) < 2 or time.monotonic() - max(since_s.values()) < _STEADY_S:
            if time.monotonic() > end_s:
                told = ", ".join(f"{site.label} {state}" for site, state in states.items())
                raise BenchmarkError(f"not engaged within {patience_s:.0f} s: {told or 'mute'}")
            time.sleep(_POLL_S)
            for site, batches in self._collect().items():
                if not batches:
                    continue
                rows = batches[-1]
                states[site] = State(rows["state"][-1]).name
                if rows["state"][-1] != State.ENGAGED or rows["force_share"].min() < 1.0:
                    since_s.pop(site, None)
                else:
                    since_s.setdefault(site, time.monotonic())

    def _collect(self) -> dict[SiteId, list[RowArray]]:
        self.check_alive()
        heard: dict[SiteId, list[RowArray]] = {}
        for site, subscription in self._telemetry.items():
            try:
                heard[site] = [decode_batch(data).rows for _, data in subscription.receive()]
            except TelemetryError as error:
                raise BenchmarkError(f"telemetry of the {site.label} site: {error}") from error
        return heard

    def _write_session(self, site: SiteId) -> Path:
        own: dict[str, TomlValue | None] = {
            "name": self._name,
            "recorder.directory": str(Path(self._folder.name) / "recordings"),
            "network.router": self._router,
        }
        file = Path(self._folder.name) / f"{site.label}.toml"
        text = edited(DEMO.read_text(encoding="utf-8"), own | self._changes)
        file.write_text(text, encoding="utf-8")
        return file

    def _start(self, site: SiteId) -> subprocess.Popen[bytes]:
        arguments = ["--listen", self._endpoints[site], "--duration", str(LONGEST_S), "--quiet"]
        if self._router is None and site is SiteId.LOCAL:
            arguments += ["--connect", self._endpoints[SiteId.REMOTE]]
        command = [sys.executable, "-m", f"{site.label}_site", str(self._write_session(site))]
        with self._log(site).open("wb") as log:
            return subprocess.Popen(  # noqa: S603 - our own module
                [*command, *arguments, *self._options],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,  # the terminal's Ctrl-C reaches them through us
            )

    def _log(self, site: SiteId) -> Path:
        return Path(self._folder.name) / f"{site.label}.log"

    def _end(self) -> None:
        for process in self._processes.values():
            process.send_signal(signal.SIGTERM)
        for process in self._processes.values():
            try:
                process.wait(_END_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        self._folder.cleanup()


def free_endpoint() -> str:
    """Return an endpoint on loopback whose port nobody has now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"
