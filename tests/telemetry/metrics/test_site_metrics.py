"""From rows to what a scrape reads, held against the rows themselves."""

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.parser import text_string_to_metric_families

from telemetry.metrics.row_counts import STAGES
from telemetry.metrics.site_metrics import MetricsOptions, SiteMetrics
from telemetry.row_ring import RecorderStatus
from telemetry.rows import COLUMNS, NO_PEER_STATE, REJECT_REASONS, RowArray
from telemetry.stream import TelemetryStream

FloatArray = npt.NDArray[np.float64]

READY, ENGAGED, HOLD = 1, 3, 4
STATES = {READY: "READY", ENGAGED: "ENGAGED", HOLD: "HOLD"}
OPTIONS = MetricsOptions(
    host="127.0.0.1",
    port=0,
    session_name='demo "1"',
    site="local",
    states=STATES,
    limits={1: "torque", 2: "velocity", 8: "torque rate"},
    recorded=True,
)
LENGTHS = {"scalar": (), "joint": (2,), "task": (2,), "reason": (len(REJECT_REASONS),)}


class Site:
    """A stream, and the metrics of what is put into it."""

    def __init__(self, **changes: Any) -> None:
        self.stream = TelemetryStream(2, 2, 0, 0xABC, 8, lambda _: None)
        options = MetricsOptions(
            **{
                **{name: getattr(OPTIONS, name) for name in OPTIONS.__slots__},
                **changes,
            }
        )
        self.metrics = SiteMetrics(self.stream.ring, options)
        self._registry = CollectorRegistry()
        self._registry.register(self.metrics)

    def put(self, **fields: Any) -> None:
        """One row: zeros, where nothing else is said."""
        row = {
            name: np.zeros(LENGTHS[column.axis], column.format)
            for name, column in COLUMNS.items()
            if name != "sequence"
        }
        self.stream.put(**row | {"state": READY, "read_ns": 1} | fields)

    @property
    def rows(self) -> RowArray:
        return self.stream.last(self.stream.count)

    def scraped(self) -> dict[str, float]:
        """Samples by their name and own labels, as a server would read them."""
        return samples(generate_latest(self._registry).decode())


def samples(text: str) -> dict[str, float]:
    found = {}
    for family in text_string_to_metric_families(text):
        for sample in family.samples:
            labels = dict(sample.labels)
            assert (labels.pop("session"), labels.pop("site")) == ('demo "1"', "local")
            own = ",".join(f"{name}={labels[name]}" for name in sorted(labels, key=_le_last))
            found[f"{sample.name}{{{own}}}" if own else sample.name] = sample.value
    return found


def _le_last(label: str) -> tuple[bool, str]:
    return label == "le", label


def assert_counted(
    found: Mapping[str, float], name: str, values: FloatArray, own: str = ""
) -> None:
    """The histogram `name` holds just these values [s]."""
    plain = f"{{{own}}}" if own else ""
    bounds = {
        key.rpartition("le=")[2].rstrip("}"): count
        for key, count in found.items()
        if key.startswith(f"{name}_bucket{{{own}")
    }
    assert len(bounds) > 10
    for bound, count in bounds.items():
        assert count == np.count_nonzero(values <= float(bound)), bound
    assert found[f"{name}_count{plain}"] == len(values)
    assert found[f"{name}_sum{plain}"] == pytest.approx(values.sum())


@pytest.fixture
def site() -> Site:
    return Site()


def put_random(site: Site, count: int, seed: int, update: Callable[[], None]) -> None:
    random = np.random.default_rng(seed)
    counts = np.zeros(len(REJECT_REASONS), int)
    stamp_ns = 0
    for k in range(count):
        counts[random.integers(len(counts))] += 1
        driven, sent = random.random() < 0.7, random.random() < 0.5
        if random.random() < 0.6:
            stamp_ns += 1_000_000
        read_ns, step_ns, write_ns, sent_ns = np.cumsum(random.integers(1000, 90_000, 4))
        unknown = random.random() < 0.2
        site.put(
            stamp_ns=k * 1_000_000 + 5_000_000_000,
            lateness_ns=int(random.choice([0, 5000, 10_000, 99_999, 100_000, 10**8, 10**10])),
            duration_ns=int(random.integers(1, 3_000_000)),
            read_ns=read_ns,
            step_ns=step_ns if driven else 0,
            write_ns=write_ns if driven else 0,
            sent_ns=sent_ns if sent else 0,
            state=int(random.choice(list(STATES))),
            cut=int(random.integers(16)),
            used_stamp_ns=stamp_ns,
            used_arrival_ns=0 if stamp_ns == 0 else k * 1_000_000 + 4_960_000_000,
            clock_offset_ns=4_900_000_000,
            clock_uncertainty_ns=300_000,
            round_trip_s=math.nan if unknown else random.uniform(0, 0.3),
            one_way_delay_s=math.nan if unknown else random.uniform(0, 0.1),
            rejected=counts,
            lost=k,
            late=2 * k,
            missed=3 * k,
        )
        if random.random() < 0.05:
            update()


@pytest.mark.parametrize("seed", range(3))
def test_every_row_is_counted_however_often_it_is_asked_for(site: Site, seed: int) -> None:
    put_random(site, 900, seed, site.metrics.update if seed else lambda: None)
    found, rows = site.scraped(), site.rows
    assert found["farhand_ticks_total"] == 900
    assert_counted(found, "farhand_wakeup_lateness_seconds", rows["lateness_ns"] / 1e9)
    # the first row's is that of no tick
    assert_counted(found, "farhand_tick_duration_seconds", rows["duration_ns"][1:] / 1e9)
    for name in ("round_trip", "one_way_delay"):
        known = rows[f"{name}_s"][~np.isnan(rows[f"{name}_s"])]
        assert 0 < len(known) < 900
        assert_counted(found, f"farhand_{name}_seconds", known)
    for limit, mask in (("torque", 1), ("velocity", 2), ("torque rate", 8)):
        cut = np.count_nonzero(rows["cut"] & mask)
        assert found[f"farhand_guard_cut_ticks_total{{limit={limit}}}"] == cut
    for number, name in STATES.items():
        entered = np.diff(rows["state"], prepend=0).astype(bool) & (rows["state"] == number)
        entries = found[f"farhand_state_entries_total{{state={name}}}"]
        assert entries == np.count_nonzero(entered)
    last = rows[-1]
    for reason, count in zip(REJECT_REASONS, last["rejected"], strict=True):
        assert found[f"farhand_packets_rejected_total{{reason={reason}}}"] == count
    for name, column in (
        ("packets_lost", "lost"),
        ("packets_late", "late"),
        ("missed_ticks", "missed"),
    ):
        assert found[f"farhand_{name}_total"] == last[column]


def test_each_stage_takes_from_the_end_of_the_one_before(site: Site) -> None:
    put_random(site, 500, 7, lambda: None)
    found, rows = site.scraped(), site.rows
    ends = {stage: rows[column].astype(float) for stage, column in STAGES.items()}
    driven, sent = ends["step"] > 0, ends["send"] > 0
    assert 0 < np.count_nonzero(driven) < 500
    assert 0 < np.count_nonzero(driven & sent) < np.count_nonzero(sent) < 500
    written = np.where(driven, ends["write"], ends["read"])
    expected = {
        "read": ends["read"],
        "step": (ends["step"] - ends["read"])[driven],
        "write": (ends["write"] - ends["step"])[driven],
        "send": (ends["send"] - written)[sent],
    }
    for stage, taken_ns in expected.items():
        assert_counted(found, "farhand_stage_seconds", taken_ns / 1e9, f"stage={stage}")


def test_ticks_of_a_stopped_site_do_not_repeat_what_it_measured(site: Site) -> None:
    for _ in range(3):
        site.put(read_ns=10_000, duration_ns=200_000, sent_ns=30_000)
    for _ in range(50):
        site.stream.repeat_stopped(stamp_ns=0, time_ns=0, lateness_ns=1000, state=HOLD, requests=0)
    found = site.scraped()
    assert found["farhand_ticks_total"] == 53
    assert found["farhand_wakeup_lateness_seconds_count"] == 53
    assert found["farhand_tick_duration_seconds_count"] == 2
    assert found["farhand_stage_seconds_count{stage=read}"] == 3
    assert found["farhand_stage_seconds_count{stage=send}"] == 3


def test_each_sample_of_the_peer_counts_once_by_where_it_waited(site: Site) -> None:
    ms = 1_000_000
    # two samples, the first used for two ticks, before them none
    for stamp, used, arrival in ((100, 0, 0), (101, 40, 71), (102, 40, 71), (103, 41, 72)):
        site.put(
            stamp_ns=stamp * ms,
            used_stamp_ns=used * ms,
            used_arrival_ns=arrival * ms,
            clock_offset_ns=20 * ms if used else 0,
            clock_uncertainty_ns=2 * ms if used else -1,
        )
        site.metrics.update()
    found = site.scraped()
    assert_counted(found, "farhand_network_delay_seconds", np.array([0.011, 0.011]))
    assert_counted(found, "farhand_hold_seconds", np.array([0.030, 0.031]))
    assert found["farhand_clock_offset_seconds"] == 0.02
    assert found["farhand_clock_uncertainty_seconds"] == 0.002


def test_one_gauge_is_up_for_the_state_of_each_site(site: Site) -> None:
    site.put(state=ENGAGED, peer_state=NO_PEER_STATE)

    def up(name: str) -> list[str]:
        found = site.scraped()
        return [state for state in STATES.values() if found[f"{name}{{state={state}}}"] == 1]

    assert up("farhand_state") == ["ENGAGED"]
    assert up("farhand_peer_state") == []
    site.put(state=HOLD, peer_state=READY)
    assert up("farhand_state") == ["HOLD"]
    assert up("farhand_peer_state") == ["READY"]
    found = site.scraped()
    assert found["farhand_state_entries_total{state=ENGAGED}"] == 1
    assert found["farhand_state_entries_total{state=READY}"] == 0


def test_the_margin_is_what_the_gains_are_proven_for_less_the_greatest_age(site: Site) -> None:
    site.put(loop_bound_s=0.21, certified_round_trip_s=0.3, force_share=0.4)
    found = site.scraped()
    assert found["farhand_margin_seconds"] == pytest.approx(0.09)
    assert found["farhand_loop_bound_seconds"] == 0.21
    assert found["farhand_certified_round_trip_seconds"] == 0.3
    assert found["farhand_force_share"] == 0.4


def test_what_is_not_known_is_not_zero(site: Site) -> None:
    names = ["loop_bound", "margin", "clock_offset", "clock_uncertainty"]

    def unknown() -> list[str]:
        found = site.scraped()
        return [name for name in names if math.isnan(found[f"farhand_{name}_seconds"])]

    assert unknown() == names  # no row yet
    assert set(STATES.values()) == {"READY", "ENGAGED", "HOLD"}
    assert not any(site.scraped()[f"farhand_state{{state={name}}}"] for name in STATES.values())
    site.put(loop_bound_s=math.nan, certified_round_trip_s=0.3, clock_uncertainty_ns=-1)
    assert unknown() == names
    site.put(loop_bound_s=0.1, certified_round_trip_s=0.3, clock_uncertainty_ns=5)
    assert unknown() == []


def test_rows_that_were_overwritten_unseen_are_told(site: Site) -> None:
    for _ in range(10):
        site.put()
    site.metrics.update()
    for _ in range(site.stream.ring.layout.capacity + 40):
        site.put()
    found = site.scraped()
    assert found["farhand_metrics_rows_lost_total"] == 41
    assert found["farhand_ticks_total"] == site.stream.count
    assert found["farhand_wakeup_lateness_seconds_count"] == site.stream.count - 41


def test_the_recorder_is_told_as_it_tells_of_itself(site: Site) -> None:
    for _ in range(100):
        site.put()
    site.stream.ring.status = RecorderStatus(False, 70, 12, 2, "No space left")
    found = site.scraped()
    expected = {
        "recording": 0,
        "rows_written_total": 70,
        "rows_lost_total": 12,
        "backlog_rows": 18,
        "incidents_total": 2,
    }
    assert {name: found[f"farhand_recorder_{name}"] for name in expected} == expected
    site.stream.ring.status = RecorderStatus(True, 70, 12, 2, "")
    assert site.scraped()["farhand_recorder_recording"] == 1


def test_without_a_recorder_it_is_told_that_nothing_is_recorded() -> None:
    found = Site(recorded=False).scraped()
    recorder = {name: value for name, value in found.items() if "recorder" in name}
    assert recorder == {"farhand_recorder_recording": 0}


def test_the_build_names_the_session_and_the_run(site: Site) -> None:
    [info] = [name for name in site.scraped() if name.startswith("farhand_build_info")]
    assert "digest=0000000000000abc" in info
    assert "epoch=8" in info
    for program in ("farhand", "python", "numpy", "eclipse_zenoh", "pin"):
        assert f"{program}=" in info


def test_options_survive_the_way_to_the_process() -> None:
    assert "\n" not in OPTIONS.to_json()
    assert MetricsOptions.from_json(OPTIONS.to_json()) == OPTIONS
