"""What the dashboard draws, read back from the files that it saves."""

import dataclasses
import threading
import urllib.request
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
import rerun as rr
from rerun.chunk import RrdReader

from telemetry.dashboard import (
    Arrival,
    Dashboard,
    LiveServer,
    Painter,
    RecordingFile,
    save_recording,
    start_viewer,
)
from telemetry.dashboard.arms import FRAME_NS
from telemetry.dashboard.certificate import certificate_text
from telemetry.dashboard.stages import latency_text
from telemetry.dashboard.styles import STATE_COLOURS, written
from telemetry.picture import Scene
from telemetry.rows import RowArray, TelemetryError, row_dtype
from tests.ports import free_port
from tests.telemetry.boards import (
    DEADLINE_S,
    MS,
    PASSAGES_NS,
    STATES,
    Chain,
    FloatArray,
    Recording,
    picture_of,
    read,
    scalars,
    verify,
    wait_for,
)


@pytest.fixture(autouse=True)
def strict() -> Iterator[None]:
    rr.set_strict_mode(True)
    yield
    rr.set_strict_mode(False)


def norm_of(rows: RowArray, field: str) -> FloatArray:
    return np.linalg.norm(rows[field], axis=1)


@pytest.fixture(scope="module")
def saved(run: Any, chain: Chain, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("saved") / "run.rrd"
    save_recording(path, picture_of(chain), run.batches(PASSAGES_NS))
    return path


@pytest.fixture(scope="module")
def recording(saved: Path) -> Recording:
    return read(saved)


def test_the_file_is_sound_and_has_a_blueprint(saved: Path) -> None:
    verify(saved)
    assert RrdReader(saved).blueprints()


def test_every_signal_is_recorded_bit_for_bit(run: Any, recording: Recording) -> None:
    for name, rows in (("local", run.local), ("remote", run.remote)):
        error_m = np.linalg.norm(rows["position_m"] - rows["peer_position_m"], axis=1)
        expected = {
            "error": error_m * 1e3,
            "force": np.column_stack(
                (norm_of(rows, "external_force_n"), norm_of(rows, "coupling_force_n"))
            ),
            "torque": rows["torque_nm"],
            "delay": rows["one_way_delay_s"] * 1e3,
            "round_trip": rows["loop_bound_s"] * 1e3,
            "lateness": rows["lateness_ns"] * 1e-3,
            "angle": rows["q"],
            "speed": rows["q_dot"],
            "clearance": rows["q"][:, 0] * 1e3,
            "margin": (rows["certified_round_trip_s"] - rows["loop_bound_s"]) * 1e3,
        }
        for path, values in expected.items():
            times_ns, recorded = scalars(recording, f"/{path}/{name}")
            assert np.array_equal(times_ns, rows["time_ns"]), path
            assert recorded.tobytes() == values.reshape(len(rows), -1).tobytes(), path


def test_the_distance_of_the_two_is_at_equal_times(run: Any, recording: Recording) -> None:
    times_ns, recorded = scalars(recording, "/error/apart")
    apart_m = np.linalg.norm(run.local["position_m"] - run.remote["position_m"], axis=1)
    assert np.array_equal(times_ns, run.local["time_ns"])
    assert recorded[:, 0] == pytest.approx(apart_m * 1e3, abs=1e-9)


def test_the_certified_round_trip_is_a_line_of_its_own(recording: Recording) -> None:
    times_ns, recorded = scalars(recording, "/round_trip/certified")
    assert len(times_ns) == 12_000
    assert (recorded == 400.0).all()


def test_the_margin_has_its_limit_at_zero(recording: Recording) -> None:
    times_ns, recorded = scalars(recording, "/margin/limit")
    assert len(times_ns) == 12_000
    assert (recorded == 0.0).all()


def test_what_the_energy_meter_says_is_recorded(run: Any, recording: Recording) -> None:
    times_ns, parts = scalars(recording, "/energy/parts")
    # from the first millisecond that both sites were heard at
    assert (np.diff(times_ns) >= 10 * MS).all()
    assert times_ns[-1] == pytest.approx(12_000 * MS, abs=60 * MS)
    rows = times_ns // MS
    local_m, remote_m = run.local["position_m"][rows], run.remote["position_m"][rows]
    expected = np.column_stack((local_m[:, 0], remote_m[:, 0], local_m[:, 1] - remote_m[:, 1]))
    assert parts == pytest.approx(expected, abs=1e-9)
    assert scalars(recording, "/energy/V")[1][:, 0] == pytest.approx(expected.sum(axis=1), abs=1e-9)
    for name, position_m in (("local", local_m), ("remote", remote_m)):
        work_ns, work = scalars(recording, f"/exchange/{name}")
        assert np.array_equal(work_ns, times_ns)
        assert work == pytest.approx(position_m, abs=1e-9)


def test_without_a_meter_no_energy_is_drawn(run: Any, chain: Chain, tmp_path: Path) -> None:
    picture = dataclasses.replace(picture_of(chain), meter=None)
    save_recording(tmp_path / "run.rrd", picture, run.batches(PASSAGES_NS)[:20])
    recorded = read(tmp_path / "run.rrd")
    assert "/torque/local" in recorded
    assert not [path for path in recorded if path.startswith(("/energy", "/exchange"))]


def test_the_panels_are_written_again_for_viewers_that_come_late(recording: Recording) -> None:
    for path, most_ns, heading in (
        ("/certificate", 350 * MS, "# **"),
        ("/latency", 1_150 * MS, "| stage |"),
    ):
        times_ns, components = recording[path]
        assert (np.diff(times_ns) <= most_ns).all()
        assert times_ns[-1] == pytest.approx(12_000 * MS, abs=most_ns)
        assert all(text.startswith(heading) for [text] in components["TextDocument:text"])
        assert set(map(tuple, components["TextDocument:media_type"])) == {("text/markdown",)}


def row(**values: Any) -> Any:
    rows = np.zeros(1, row_dtype(2, 2))
    defaults = {"state": 2, "force_share": 1.0, "loop_bound_s": 0.25}
    for name, value in (defaults | {"certified_round_trip_s": 0.4} | values).items():
        rows[name] = value
    return rows[0]


@pytest.mark.parametrize(
    ("local", "remote", "told"),
    [
        (
            {"position_m": (0.03, 0.0)},
            {"loop_bound_s": 0.26, "position_m": (0.0, 0.04)},
            ["CERTIFIED** margin **+140 ms**", "loop **260** of 400 ms (Theorem B)",
             "local **ENGAGED 100%**", "apart **50 mm**"],
        ),
        (
            {"loop_bound_s": 0.45, "force_share": 0.8},
            {},
            ["BEYOND THE CERTIFICATE** margin **-50 ms**", "local **ENGAGED 80%**"],
        ),
        (
            {"state": 5, "force_share": 0.0, "loop_bound_s": np.nan, "offset_m": (0.02, 0.0)},
            {"state": 5, "force_share": 0.0, "loop_bound_s": np.nan},
            ["NO LOOP** yet · certified up to 400 ms", "local **ALIGNING**",
             "apart **20 mm** (engages within 20 mm)"],
        ),
        ({"certified_round_trip_s": 0.0}, {}, ["NOT CERTIFIED"]),
        ({"certified_round_trip_s": np.inf}, None, ["# loop **250 ms**"]),
        (None, {"state": 9}, ["local **silent**", "remote **state 9 100%**"]),
        (None, None, ["NO LOOP", "remote **silent**"]),
    ],
)  # fmt: skip
def test_the_certificate_at_a_glance(
    chain: Chain, local: dict[str, Any] | None, remote: dict[str, Any] | None, told: list[str]
) -> None:
    rows = [None if values is None else row(**values) for values in (local, remote)]
    text = certificate_text(picture_of(chain), rows[0], rows[1])
    for part in told:
        assert part in text


def test_latencies_are_a_table_of_both_directions() -> None:
    local, remote = (np.zeros(20, row_dtype(2, 2)) for _ in range(2))
    for rows in (local, remote):
        rows["stamp_ns"] = 1_000 * MS + np.arange(20) * MS
        rows["read_ns"], rows["step_ns"], rows["write_ns"] = 50_000, 250_000, 270_000
        rows["sent_ns"] = 290_000
    # the remote uses each local sample five ticks later, having had it after two
    remote["used_stamp_ns"][5:] = local["stamp_ns"][:-5]
    remote["used_arrival_ns"][5:] = local["stamp_ns"][:-5] + 2 * MS
    lines = latency_text(("local", "remote"), local, remote).splitlines()
    assert lines[0] == "| stage | local → remote | remote → local |"
    cells = {line.split(" | ")[0].strip("| *"): line.split(" | ")[1:] for line in lines[2:]}
    assert cells["read"][0] == "0.05 / 0.05"
    assert cells["control"][0] == "0.20 / 0.20"
    assert cells["network"][0] == "1.71 / 1.71"
    assert cells["hold"][0] == "3.00 / 3.00"
    assert cells["total"][0] == "**5.27 / 5.27**"
    assert all(way[1].strip("|* ") == "– / –" for way in cells.values())


def test_every_state_has_a_colour_of_its_own() -> None:
    assert set(STATES.values()) == set(STATE_COLOURS)
    assert len(set(STATE_COLOURS.values())) == len(STATE_COLOURS)


def test_only_letters_that_the_viewer_has_are_written() -> None:
    assert written("Säule λ Ж q̇ · 3") == "Säule λ Ж q̇ · 3"
    assert written("\U0001f7e2 post\n柱") == "? post??"


def test_arms_are_drawn_at_thirty_frames_a_second(
    run: Any, recording: Recording, chain: Chain
) -> None:
    for name, rows in (("local", run.local), ("remote", run.remote)):
        times_ns, components = recording[f"/scene/{name}/arm"]
        assert (np.diff(times_ns) == FRAME_NS).all()
        assert len(times_ns) == pytest.approx(12 * 30, abs=2)
        expected = chain(rows["q"][times_ns // MS])[:, :, :2].astype(np.float32)
        assert np.array_equal(np.array(components["LineStrips2D:strips"])[:, 0], expected)


def test_the_ghost_is_the_peer_one_delay_ago(run: Any, recording: Recording, chain: Chain) -> None:
    for name, rows, peer in (
        ("local", run.local, run.remote),
        ("remote", run.remote, run.local),
    ):
        times_ns, components = recording[f"/scene/{name}/ghost"]
        ghosts = components["LineStrips2D:strips"]
        delays_s = rows["one_way_delay_s"][times_ns // MS]
        drawn = np.array([bool(ghost) for ghost in ghosts])
        # Until the peer is heard there is nothing to draw.
        assert np.array_equal(drawn, np.isfinite(delays_s))
        assert not drawn[0]
        then_ns = times_ns[drawn] - (delays_s[drawn] * 1e9).astype(np.int64)
        expected = chain(peer["q"][then_ns // MS])[:, :, :2].astype(np.float32)
        recorded = np.array([ghost[0] for ghost in ghosts if ghost])
        assert np.array_equal(recorded, expected)


def test_forces_are_two_arrows_from_the_tip(run: Any, recording: Recording, chain: Chain) -> None:
    picture = picture_of(chain)
    for name, rows in (("local", run.local), ("remote", run.remote)):
        times_ns, components = recording[f"/scene/{name}/forces"]
        shown = rows[times_ns // MS]
        vectors = np.array(components["Arrows2D:vectors"])
        origins = np.array(components["Arrows2D:origins"])
        tips_m = chain(shown["q"])[:, -1, :2].astype(np.float32)
        for arrow, force in enumerate(("coupling", "external")):
            expected = picture.arrows(shown[f"{force}_force_n"]).astype(np.float32)
            assert np.array_equal(vectors[:, arrow], expected), force
            assert np.array_equal(origins[:, arrow], tips_m)


def test_a_ghost_waits_for_the_peers_rows(run: Any, chain: Chain, tmp_path: Path) -> None:
    painter = Painter(picture_of(chain), rr.FileSink(tmp_path / "run.rrd"))
    for batch, arrival_ns in run.batches(PASSAGES_NS)[:40]:
        rows = batch.rows.copy()
        rows["one_way_delay_s"] = 1e-3
        painter.consume([(dataclasses.replace(batch, rows=rows), arrival_ns)], False)
    painter.consume([], True)
    times_ns, components = read(tmp_path / "run.rrd")["/scene/local/ghost"]
    # At first the peer's clock is still unknown.
    known = times_ns > 500 * MS
    expected = chain(run.remote["q"][(times_ns[known] - MS) // MS])[:, :, :2].astype(np.float32)
    ghosts = components["LineStrips2D:strips"]
    recorded = np.array([ghosts[i][0] for i in np.flatnonzero(known)])
    assert np.array_equal(recorded, expected)


def test_trails_hold_three_seconds(recording: Recording) -> None:
    for name in ("local", "remote"):
        _, arms = recording[f"/scene/{name}/arm"]
        _, trails = recording[f"/scene/{name}/trail"]
        lengths = [len(trail[0]) for trail in trails["LineStrips2D:strips"]]
        assert lengths == [min(i + 1, 90) for i in range(len(lengths))]
        assert trails["LineStrips2D:strips"][200][0][0] == arms["LineStrips2D:strips"][111][0][-1]


def test_states_are_told_at_their_changes(recording: Recording) -> None:
    times_ns, components = recording["/state/local"]
    told = [state for [state] in components["StateChange:state"]]
    assert list(zip((times_ns // MS).tolist(), told, strict=True)) == [
        (0, "0"),
        (500, "1"),
        (2000, "2"),
        (6501, "3"),
        (7400, "2"),
    ]


def test_a_state_that_lasts_is_told_again_for_viewers_that_come_late(
    run: Any, chain: Chain, tmp_path: Path
) -> None:
    lasting = []
    for batch, arrival_ns in run.batches(PASSAGES_NS):
        rows = batch.rows.copy()
        rows["state"] = 2
        lasting.append((dataclasses.replace(batch, rows=rows), arrival_ns))
    save_recording(tmp_path / "run.rrd", picture_of(chain), lasting)
    times_ns, components = read(tmp_path / "run.rrd")["/state/remote"]
    assert (times_ns // MS).tolist() == [0, 5_000, 10_000]
    assert components["StateChange:state"] == [["2"]] * 3


def test_events_carry_level_and_time(recording: Recording) -> None:
    _, components = recording["/events"]
    texts = [text for [text] in components["TextLog:text"]]
    levels = [level for [level] in components["TextLog:level"]]
    told = dict(zip(texts, levels, strict=True))
    assert told["   2.000 s  local is ENGAGED"] == "INFO"
    assert told["   6.501 s  remote is HOLD: nothing new of the peer for 6501 ms"] == "WARN"
    assert any("missed 3 ticks" in text for text in texts)
    assert any("rejected 2 packets" in text for text in texts)
    assert any("limit on torque" in text for text in texts)


def test_without_a_limit_or_an_obstacle_nothing_is_drawn_of_them(
    run: Any, chain: Chain, tmp_path: Path
) -> None:
    batches = run.batches(PASSAGES_NS)[:40]
    unlimited: list[Arrival] = []
    for batch, arrival_ns in batches:
        rows = batch.rows.copy()
        rows["certified_round_trip_s"] = np.inf
        unlimited.append((dataclasses.replace(batch, rows=rows), arrival_ns))
    save_recording(tmp_path / "run.rrd", picture_of(chain, scene=Scene()), unlimited)
    recorded = read(tmp_path / "run.rrd")
    assert "/round_trip/local" in recorded
    assert "/round_trip/certified" not in recorded
    assert "/margin/local" not in recorded
    assert "/margin/limit" not in recorded
    assert "/clearance/local" not in recorded


def test_a_site_alone_is_shown(run: Any, chain: Chain, tmp_path: Path) -> None:
    alone = [item for item in run.batches(PASSAGES_NS) if item[0].site == 1][:40]
    save_recording(tmp_path / "run.rrd", picture_of(chain), alone)
    recorded = read(tmp_path / "run.rrd")
    assert len(recorded["/torque/remote"][0]) == 2000
    assert len(recorded["/scene/remote/arm"][0]) == pytest.approx(60, abs=1)
    assert "/error/apart" not in recorded
    assert "/scene/local/arm" not in recorded


def test_a_site_that_falls_silent_does_not_hold_its_peer(
    run: Any, chain: Chain, tmp_path: Path
) -> None:
    batches = [
        item for item in run.batches(PASSAGES_NS) if item[0].site == 0 or item[1] < 107_000 * MS
    ]
    painter = Painter(picture_of(chain), rr.FileSink(tmp_path / "run.rrd"))
    for item in batches[:-1]:
        painter.consume([item], False)
    painter.consume([], True)
    recorded = read(tmp_path / "run.rrd")
    assert recorded["/torque/local"][0][-1] > 11_900 * MS
    assert recorded["/scene/local/arm"][0][-1] > 11_900 * MS
    # The silent arm is not redrawn after half a second.
    assert recorded["/scene/remote/arm"][0][-1] == pytest.approx(2_500 * MS, abs=2 * FRAME_NS)


def test_a_restarted_site_goes_on_later_on_the_timeline(
    run: Any, chain: Chain, tmp_path: Path
) -> None:
    batches = run.batches(PASSAGES_NS)[:80]
    again = []
    for batch, arrival_ns in batches:
        rows = batch.rows.copy()
        rows["stamp_ns"] -= 4_000 * MS
        again.append(
            (
                dataclasses.replace(batch, epoch=2, rows=rows),
                arrival_ns + 3_000 * MS,
            )
        )
    save_recording(tmp_path / "run.rrd", picture_of(chain), batches + again)
    times_ns, _ = scalars(read(tmp_path / "run.rrd"), "/torque/local")
    assert len(times_ns) == 4000
    assert (np.diff(times_ns) > 0).all()
    assert times_ns[2000] == 3_000 * MS


@pytest.mark.parametrize("dimension", [2, 3])
def test_arms_in_space_and_in_the_plane(
    run: Any, spatial_run: Any, chain: Chain, tmp_path: Path, dimension: int
) -> None:
    batches = (run if dimension == 2 else spatial_run).batches(PASSAGES_NS)[:40]
    save_recording(tmp_path / "run.rrd", picture_of(chain, dimension), batches)
    verify(tmp_path / "run.rrd")
    _, components = read(tmp_path / "run.rrd")["/scene/remote/arm"]
    assert np.array(components[f"LineStrips{dimension}D:strips"]).shape[1:] == (1, 4, dimension)


# Live


def test_a_dashboard_saves_what_it_is_offered(run: Any, chain: Chain, tmp_path: Path) -> None:
    shown = Dashboard(picture_of(chain), [RecordingFile(tmp_path / "run.rrd")])
    for batch, arrival_ns in run.batches(PASSAGES_NS)[:60]:
        shown.offer(batch, arrival_ns)
    assert shown.close(DEADLINE_S)
    assert shown.dropped_batches == 0
    verify(tmp_path / "run.rrd")
    assert len(read(tmp_path / "run.rrd")["/torque/remote"][0]) == 1500


def test_a_stalled_sink_never_blocks_and_its_losses_are_counted(
    run: Any, chain: Chain, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    blocked, release = threading.Event(), threading.Event()
    consume = Painter.consume

    def stall(self: Painter, items: Sequence[Arrival], last: bool) -> None:
        if items and not release.is_set():
            blocked.set()
            assert release.wait(DEADLINE_S)
        consume(self, items, last)

    monkeypatch.setattr(Painter, "consume", stall)
    batches = run.batches(PASSAGES_NS)
    shown = Dashboard(picture_of(chain), [RecordingFile(tmp_path / "run.rrd")], queue_batches=20)
    shown.offer(*batches[0])
    assert blocked.wait(DEADLINE_S)
    wait_for(lambda: shown.stalled_s() > 0.02)
    # Were one of these to block, the sink would not be let go.
    for batch, arrival_ns in batches[1:301]:
        shown.offer(batch, arrival_ns)
    assert shown.dropped_batches == 280
    assert not shown.close(0.0)
    release.set()
    assert shown.close(DEADLINE_S)
    assert shown.stalled_s() == 0.0
    assert len(read(tmp_path / "run.rrd")["/torque/local"][0]) == pytest.approx(10 * 50, abs=50)


def test_batches_of_other_arms_are_refused(run: Any, chain: Chain, tmp_path: Path) -> None:
    shown = Dashboard(picture_of(chain), [RecordingFile(tmp_path / "run.rrd")])
    batch, arrival_ns = run.batches(PASSAGES_NS)[0]
    other = dataclasses.replace(batch, site=1 - batch.site)
    with pytest.raises(TelemetryError, match="another session"):
        shown.offer(other, arrival_ns)
    assert shown.close(DEADLINE_S)


def test_a_place_that_cannot_be_written_is_named(chain: Chain, tmp_path: Path) -> None:
    with pytest.raises(TelemetryError, match="nowhere"):
        Dashboard(picture_of(chain), [RecordingFile(tmp_path / "nowhere" / "run.rrd")])


def listening(process: psutil.Process) -> set[tuple[str, int]]:
    return {
        (connection.laddr.ip, connection.laddr.port)
        for connection in process.net_connections("inet")
        if connection.status == psutil.CONN_LISTEN
    }


def test_live_pages_are_served_on_loopback_only(
    chain: Chain, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    live = LiveServer(free_port())
    shown = Dashboard(picture_of(chain), [live])
    wait_for(lambda: ("127.0.0.1", live.port) in listening(psutil.Process()))
    with pytest.raises(TelemetryError, match=str(live.port)):
        Dashboard(picture_of(chain), [live])
    web_port = free_port()
    viewer = start_viewer(live, web_port)
    try:
        assert str(live.port) in viewer.address
        with urllib.request.urlopen(viewer.address, timeout=DEADLINE_S) as page:  # noqa: S310
            assert page.status == 200
        addresses = listening(psutil.Process(viewer.process.pid))
        assert ("127.0.0.1", web_port) in addresses
        assert {ip for ip, _ in addresses} == {"127.0.0.1"}
    finally:
        viewer.close()
    assert viewer.process.returncode is not None
    assert shown.close(DEADLINE_S)
