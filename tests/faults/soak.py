"""Both daemons under a random schedule of faults, watched all the while.

python -m tests.faults.soak [--minutes 10] [--seed 1] [--log FILE]

After each fault the sites must be ENGAGED again within RECOVERY_S, and the rows since the last look
must show: the coupling force at most the ceiling, no torque outside the driven states, no jump of
the force, and a Lyapunov–Krasovskii functional that does not rise while nobody pushes. In the end:
memory of each run flat, threads too once the network has been at rest, and its recording without a
gap. The exit code is 1 if not.
"""

import argparse
import random
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from site_runtime.keys import SiteId
from telemetry.recording import read_recording
from tests.faults import namespace, wall_clock
from tests.faults.energy import energy_rises
from tests.faults.invariants import violations
from tests.faults.network import CLEAR, ImpairedNetwork, Impairment, flap
from tests.faults.session import pulses
from tests.faults.sites import BOTH, LOCAL, REMOTE, Daemon, NotReached, SitePair

RECOVERY_S = 10.0
ORPHAN_S = 36_000.0
QUIET_S = (3.0, 8.0)
SETTLED_S = 10.0  # a run's memory is compared from this age on
MEMORY_GROWTH = 1.10
PAGE_KB = 4
MOST_THREADS = 20  # Zenoh's pools of threads, whatever the network does
REST_S = 15.0  # a pool of Zenoh's keeps a thread that has nothing to do for 10 s
LOST_AT_KILL_S = 0.1
RECORDERS_END_S = 3.0


@dataclass
class Vitals:
    """Memory [kB] and threads of one run, over its life."""

    started_s: float = field(default_factory=time.monotonic)
    memory_kb: list[int] = field(default_factory=list)
    threads: list[int] = field(default_factory=list)

    def look(self, daemon: Daemon) -> None:
        """Take a sample once the run has settled."""
        if daemon.process.poll() is not None or time.monotonic() - self.started_s < SETTLED_S:
            return
        process = Path(f"/proc/{daemon.process.pid}")
        self.memory_kb.append(int((process / "statm").read_text().split()[1]) * PAGE_KB)
        self.threads.append(len(list((process / "task").iterdir())))

    def complaint(self, *, rested: bool) -> str | None:
        """What is not flat; of threads, only the last sample of a rested network tells."""
        if len(self.memory_kb) < 3:
            return None
        if self.memory_kb[-1] > MEMORY_GROWTH * self.memory_kb[0]:
            return f"memory grew from {self.memory_kb[0]} to {self.memory_kb[-1]} kB"
        if max(self.threads) > MOST_THREADS:
            return f"threads grew to {max(self.threads)}"
        if rested and self.threads[-1] > min(self.threads[:-1]):
            return f"threads grew from {min(self.threads[:-1])} to {self.threads[-1]}"
        return None


class Soak:
    """The sites, the network if this machine allows one, the draw, and what has gone wrong."""

    def __init__(self, folder: Path, seed: int, log: Callable[[str], None]) -> None:
        refusal = namespace.refusal()
        self.network = ImpairedNetwork(seed) if refusal is None else None
        self.log = log
        self.wrong: list[str] = []
        self.recoveries_s: list[float] = []
        self.faults = 0
        self.intervals = 0
        self.draw = random.Random(seed)  # noqa: S311  reproducible, not secret
        self._seen_ns = 0
        self._vitals: dict[int, Vitals] = {}
        if refusal is not None:
            log(f"no impaired network ({refusal}): faults of processes only")
        self.pair = SitePair(folder, network=self.network, operator=pulses(60), orphan_s=ORPHAN_S)

    def run(self, for_s: float) -> None:
        """Fault after fault, until the time is over."""
        end_s = time.monotonic() + for_s
        self.pair.start(REMOTE, LOCAL)
        self._seen_ns = time.monotonic_ns()
        self._recover("start")
        acts = self._acts()
        while time.monotonic() < end_s:
            time.sleep(self.draw.uniform(*QUIET_S))
            self._look()
            name, act = self.draw.choice(acts)
            told = act()
            self.faults += 1
            self._recover(f"{name} {told}")
            self._look()
        time.sleep(REST_S)
        self._look()
        self.log(
            f"after {REST_S:g} s of rest: "
            + ", ".join(
                f"{site.label} {vitals.threads[-1]} threads (at most {max(vitals.threads)}), "
                f"{vitals.memory_kb[-1]} kB (at first {vitals.memory_kb[0]})"
                for site in BOTH
                if (vitals := self._vitals[id(self.pair.daemons[site])]).threads
            )
        )
        for daemon in self.pair.crashed():
            self._complain(f"{daemon.site.label} crashed: {daemon.text()}")

    def close(self) -> None:
        """End the sites; judge their lives and their recordings."""
        last = {id(daemon) for daemon in self.pair.daemons.values()}
        self.pair.close()
        if self.network is not None:
            self.network.close()
        for daemon in self.pair.all:
            vitals = self._vitals.get(id(daemon), Vitals())
            complaint = vitals.complaint(rested=id(daemon) in last)
            if complaint is not None:
                self._complain(f"{daemon.site.label} run {daemon.epoch}: {complaint}")

    def check_recordings(self) -> int:
        """Every run without a gap and up to its last moments; return how many rows there are."""
        time.sleep(RECORDERS_END_S)
        rows = 0
        for site in BOTH:
            runs: dict[str, list[Path]] = {}
            for path in self.pair.recorded(site):
                runs.setdefault(read_recording(path)[site.label].metadata["epoch"], []).append(path)
            for daemon in self.pair.all:
                if daemon.site is not site:
                    continue
                recording = read_recording(*runs[str(daemon.epoch)])[site.label]
                rows += len(recording.rows)
                name = f"recording of {site.label} run {daemon.epoch}"
                if recording.gaps:
                    self._complain(f"{name}: gaps {recording.gaps}")
                lost_s = (daemon.killed_ns - int(recording.rows["stamp_ns"][-1])) * 1e-9
                if lost_s > LOST_AT_KILL_S:
                    self._complain(f"{name} ends {lost_s:.3f} s before the site")
        return rows

    def _acts(self) -> list[tuple[str, Callable[[], str]]]:
        draw = self.draw.uniform
        acts: list[tuple[str, Callable[[], str]]] = []
        for site in BOTH:
            acts += [
                (f"{site.label} killed", lambda site=site: self._killed(site)),
                (f"{site.label} suspended", lambda site=site: self._suspended(site)),
                (f"{site.label} stopped by its operator", lambda site=site: self._stopped(site)),
            ]
            if wall_clock.COMPILER is not None:
                acts.append((f"{site.label} wall clock", lambda site=site: self._clock(site)))
        if self.network is not None:
            acts += [
                ("blackout", lambda: self._impaired(Impairment(blackout=True), draw(0.02, 2.0))),
                ("bad network", self._bad_network),
                ("flapping link", self._flapping),
            ]
        return acts

    def _killed(self, site: SiteId) -> str:
        away_s = self.draw.uniform(0.0, 1.5)
        self.pair.kill(site)
        time.sleep(away_s)
        self.pair.start(site)
        return f"for {away_s:.2f} s"

    def _suspended(self, site: SiteId) -> str:
        away_s = self.draw.uniform(0.02, 1.5)
        self.pair.signal(site, signal.SIGSTOP)
        time.sleep(away_s)
        self.pair.signal(site, signal.SIGCONT)
        return f"for {away_s:.2f} s"

    def _stopped(self, site: SiteId) -> str:
        pair = self.pair
        since_ns = time.monotonic_ns()
        pair.signal(site, signal.SIGUSR1)
        for each in (site, site.peer):
            pair.until(
                lambda each=each: pair.state(each) == "EMERGENCY_STOP",
                f"{each.label} in EMERGENCY_STOP",
            )
        took_s = (time.monotonic_ns() - since_ns) * 1e-9
        for each in BOTH:
            pair.signal(each, signal.SIGUSR2)
        return f"both stopped, seen after {took_s:.2f} s"

    def _clock(self, site: SiteId) -> str:
        offset_s = self.draw.choice((-3600.0, 3600.0, 0.0))
        self.pair.clocks[site].set(offset_s)
        return f"to {offset_s:+.0f} s"

    def _impaired(self, impairment: Impairment, for_s: float) -> str:
        assert self.network is not None
        self.network.impair(impairment)
        time.sleep(for_s)
        self.network.impair(CLEAR)
        told = ", ".join(
            f"{name} {value:.3g}"
            for name, value in asdict(impairment).items()
            if not isinstance(value, bool) and value
        )
        return f"{told} for {for_s:.2f} s".strip()

    def _bad_network(self) -> str:
        draw = self.draw.uniform
        delay_s = draw(0.0, 0.15)
        return self._impaired(
            Impairment(
                delay_s,
                jitter_s=draw(0.0, 0.5 * delay_s),
                loss=draw(0.0, 0.2),
                reorder=draw(0.0, 0.1),
                duplicate=draw(0.0, 0.1),
            ),
            draw(1.0, 4.0),
        )

    def _flapping(self) -> str:
        assert self.network is not None
        flap(self.network, self.draw.uniform(0.05, 0.5), 3.0)
        return "for 3 s"

    def _recover(self, what: str) -> None:
        """Both ENGAGED again, in time."""
        since_s = time.monotonic()
        try:
            self.pair.until_steady(within_s=RECOVERY_S)
        except NotReached as missed:
            self._complain(f"{what}: {missed}")
            self.pair.until_steady()
        self.recoveries_s.append(time.monotonic() - since_s)
        self.log(f"{what}: both ENGAGED {self.recoveries_s[-1]:.2f} s after")

    def _look(self) -> None:
        """Ask the rows since the last look, and the processes, what the docstring says."""
        time.sleep(0.2)  # the last batches are on their way
        since_ns, self._seen_ns = self._seen_ns, time.monotonic_ns() - 200_000_000
        rows = {}
        for site in BOTH:
            daemon = self.pair.daemons[site]
            self._vitals.setdefault(id(daemon), Vitals()).look(daemon)
            rows[site] = self.pair.rows(site, since_ns)
            for what in violations(rows[site], self.pair.session, site):
                self._complain(what)
        checked, rises = energy_rises(self.pair.session, rows[LOCAL], rows[REMOTE])
        self.intervals += checked
        for what in rises:
            self._complain(what)

    def _complain(self, what: str) -> None:
        self.wrong.append(what)
        self.log("WRONG: " + what)


def main() -> int:
    """Run it; return the exit code."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--log", type=Path, default=None)
    options = parser.parse_args()
    start_s = time.monotonic()
    lines: list[str] = []

    def log(text: str) -> None:
        lines.append(f"{time.monotonic() - start_s:7.1f} s  {text}")
        sys.stdout.write(lines[-1] + "\n")
        sys.stdout.flush()
        if options.log is not None:
            options.log.write_text("\n".join(lines) + "\n", encoding="utf-8")

    log(f"seed {options.seed}, {options.minutes:g} minutes")
    with tempfile.TemporaryDirectory(prefix="farhand-soak-") as folder:
        soak = Soak(Path(folder), options.seed, log)
        try:
            soak.run(60.0 * options.minutes)
        finally:
            soak.close()
        rows = soak.check_recordings()
    recoveries_s = np.array(soak.recoveries_s)
    log(
        f"{soak.faults} faults; back to ENGAGED after {np.median(recoveries_s):.2f} s in the "
        f"median, {recoveries_s.max():.2f} s at worst; energy followed through {soak.intervals} "
        f"free intervals; {rows} rows recorded; {len(soak.wrong)} things wrong"
    )
    return 1 if soak.wrong else 0


if __name__ == "__main__":
    raise SystemExit(main())
