"""A site's Prometheus metrics, from its rows in memory that another process writes."""

import json
import platform
import threading
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from importlib.metadata import version
from math import nan
from typing import Final, Self

import numpy as np
from prometheus_client import Metric
from prometheus_client.registry import Collector

from telemetry.metrics.families import MetricFamilies
from telemetry.metrics.row_counts import RowCounts
from telemetry.row_ring import RowRing
from telemetry.rows import REJECT_REASONS

_PIECE_ROWS: Final = 2000
_PROGRAMS: Final = ("farhand", "numpy", "eclipse-zenoh", "pin")


@dataclass(frozen=True, slots=True)
class MetricsOptions:
    """What the site tells its metrics process; port 0 is any that is free.

    `states` names all supervisor states by number, `limits` the bits of `cut` by mask; `recorded`
    says that there is a recorder.
    """

    host: str
    port: int
    session_name: str
    site: str
    states: Mapping[int, str]
    limits: Mapping[int, str]
    recorded: bool

    def to_json(self) -> str:
        """Return the options as one line."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, line: str) -> Self:
        """Read what `to_json` wrote."""
        values = json.loads(line)
        for names in ("states", "limits"):
            values[names] = {int(number): name for number, name in values[names].items()}
        return cls(**values)


class SiteMetrics(Collector):
    """Counts every row of a ring, however often somebody asks."""

    def __init__(self, ring: RowRing, options: MetricsOptions) -> None:
        self._ring = ring
        self._options = options
        self._families = MetricFamilies(session=options.session_name, site=options.site)
        self._counts = RowCounts(ring.rows.dtype, options.limits)
        self._lock = threading.Lock()
        self._next_row = 0
        self._lost = 0
        self._build = {
            "digest": f"{ring.layout.digest:016x}",
            "epoch": str(ring.layout.epoch),
            "python": platform.python_version(),
            **{name.replace("-", "_"): version(name) for name in _PROGRAMS},
        }

    def update(self) -> None:
        """Count the rows that are new; often enough that none is overwritten first. Any thread."""
        with self._lock:
            while len(rows := self._ring.rows_from(self._next_row, _PIECE_ROWS)):
                self._lost += int(rows["sequence"][0]) - self._next_row
                self._next_row = int(rows["sequence"][-1]) + 1
                self._counts.add(rows)

    def collect(self) -> Iterable[Metric]:
        """Return all metrics, up to the newest row."""
        self.update()
        with self._lock:
            row = self._counts.last
            return [
                *self._of_the_loop(row),
                *self._of_the_channel(row),
                *self._of_the_states(row),
                *self._of_the_recorder(),
                *self._of_the_reader(),
            ]

    def _of_the_loop(self, row: np.void) -> list[Metric]:
        make, counts = self._families, self._counts
        return [
            make.counter("farhand_ticks", "Ticks", self._next_row),
            make.counter("farhand_missed_ticks", "Ticks skipped, the loop was late", row["missed"]),
            make.histogram(
                "farhand_wakeup_lateness_seconds",
                "Wake-up after the tick's deadline",
                counts.lateness_s,
            ),
            make.histogram(
                "farhand_tick_duration_seconds", "Computing time of a tick", counts.duration_s
            ),
            make.histograms("farhand_stage_seconds", "Parts of a tick", "stage", counts.stage_s),
            make.counters(
                "farhand_guard_cut_ticks",
                "Ticks in which the guard applied this limit",
                "limit",
                {self._options.limits[mask]: n for mask, n in counts.cut_ticks.items()},
            ),
        ]

    def _of_the_channel(self, row: np.void) -> list[Metric]:
        make, counts = self._families, self._counts
        bound_s, certified_s = row["loop_bound_s"], row["certified_round_trip_s"]
        uncertainty_ns = row["clock_uncertainty_ns"]
        known = uncertainty_ns >= 0
        return [
            make.histogram(
                "farhand_round_trip_seconds", "Age of the whole loop", counts.round_trip_s
            ),
            make.gauge(
                "farhand_loop_bound_seconds", "Greatest age of the whole loop of late", bound_s
            ),
            make.gauge(
                "farhand_certified_round_trip_seconds",
                "Age that the gains in use are proven stable for",
                certified_s,
            ),
            make.gauge(
                "farhand_margin_seconds", "Certified age less the greatest", certified_s - bound_s
            ),
            make.histogram(
                "farhand_one_way_delay_seconds",
                "Age of the peer's sample in use, at each tick",
                counts.one_way_delay_s,
            ),
            make.histogram(
                "farhand_network_delay_seconds",
                "Start of the peer's tick to the tick that took the sample in, each once",
                counts.network_delay_s,
            ),
            make.histogram(
                "farhand_hold_seconds",
                "That tick to the sample's first use, each once: what the injected delay holds",
                counts.hold_s,
            ),
            make.gauge(
                "farhand_clock_offset_seconds",
                "Own clock less the peer's",
                row["clock_offset_ns"] / 1e9 if known else nan,
            ),
            make.gauge(
                "farhand_clock_uncertainty_seconds",
                "How far off the clock offset, and so each one-way delay, may be",
                uncertainty_ns / 1e9 if known else nan,
            ),
            make.counter("farhand_packets_lost", "The peer's packets that never came", row["lost"]),
            make.counter(
                "farhand_packets_late", "The peer's packets that came too late", row["late"]
            ),
            make.counters(
                "farhand_packets_rejected",
                "Packets refused for this reason",
                "reason",
                dict(zip(REJECT_REASONS, row["rejected"], strict=True)),
            ),
        ]

    def _of_the_states(self, row: np.void) -> list[Metric]:
        make, states = self._families, self._options.states
        entries = self._counts.state_entries
        return [
            make.gauges(
                "farhand_state",
                "1 for the state that the site is in",
                "state",
                {name: row["state"] == number for number, name in states.items()},
            ),
            make.gauges(
                "farhand_peer_state",
                "1 for the state that the peer says it is in; 0 for all while none is heard",
                "state",
                {name: row["peer_state"] == number for number, name in states.items()},
            ),
            make.counters(
                "farhand_state_entries",
                "Times that the site entered this state",
                "state",
                {name: entries[number] for number, name in states.items()},
            ),
            make.gauge(
                "farhand_force_share",
                "Share of stiffness and force ceiling in force: ramp, de-rating",
                row["force_share"],
            ),
        ]

    def _of_the_recorder(self) -> list[Metric]:
        make, status = self._families, self._ring.status
        recording = make.gauge(
            "farhand_recorder_recording", "1 while the recorder can write", status.recording
        )
        if not self._options.recorded:
            return [recording]
        backlog = self._ring.row_count - status.written - status.lost
        return [
            recording,
            make.counter("farhand_recorder_rows_written", "Rows on the disk", status.written),
            make.counter(
                "farhand_recorder_rows_lost", "Rows that will never be there", status.lost
            ),
            make.gauge("farhand_recorder_backlog_rows", "Rows not yet on the disk", backlog),
            make.counter("farhand_recorder_incidents", "Incident files kept", status.incidents),
        ]

    def _of_the_reader(self) -> list[Metric]:
        make = self._families
        return [
            make.counter(
                "farhand_metrics_rows_lost", "Rows that these metrics did not see", self._lost
            ),
            make.info(
                "farhand_build_info", "Versions, session digest, epoch of the run", self._build
            ),
        ]
