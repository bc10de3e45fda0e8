import dataclasses
import io
import subprocess
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import psutil
import pytest
import rerun as rr
from PIL import Image
from rerun.chunk import RrdReader

from telemetry.dashboard import (
    Arrival,
    Dashboard,
    LiveServer,
    Painter,
    RecordingFile,
    ViewerCrashError,
    draw,
    free_port,
    headless_viewer,
    save_recording,
    screenshot,
    start_viewer,
)
from telemetry.dashboard.arms import FRAME_NS
from telemetry.picture import (
    LOCAL_COLOUR,
    RED,
    REMOTE_COLOUR,
    ObstacleView,
    Picture,
    Scene,
    SiteView,
    WallView,
)
from telemetry.rows import RowArray, TelemetryError

FloatArray = npt.NDArray[np.float64]
Chain = Callable[[FloatArray], FloatArray]
Recording = dict[str, tuple[npt.NDArray[np.int64], dict[str, list[Any]]]]

MS = 1_000_000
# The two sites' clocks read 5 s and 91 s at the start: these passages put both at 105 s.
PASSAGES_NS = (100_000 * MS, 14_000 * MS)
STATES = {0: "OFFLINE", 1: "READY", 2: "ENGAGED", 3: "HOLD", 4: "FAULT"}
SCENE = Scene(
    (ObstacleView("obstacle", (0.22, -0.12, 0.0), 0.06, 0.12),),
    (WallView((0.54, 0.0, 0.0), (-1.0, 0.0, 0.0)),),
)
DEADLINE_S = 30.0

driverless = pytest.mark.skipif(
    not any(
        icd
        for place in ("/usr/share/vulkan/icd.d", "/etc/vulkan/icd.d")
        for icd in Path(place).glob("*.json")
    ),
    reason="no Vulkan driver for the headless viewer (Debian: mesa-vulkan-drivers, libvulkan1)",
)


@pytest.fixture(autouse=True)
def strict() -> Iterator[None]:
    rr.set_strict_mode(True)
    yield
    rr.set_strict_mode(False)


def picture_of(chain: Chain, dimension: int = 2, scene: Scene = SCENE) -> Picture:
    sites = (
        SiteView("local", LOCAL_COLOUR, chain, 2, dimension),
        SiteView("remote", REMOTE_COLOUR, chain, 3, dimension),
    )
    return Picture(sites, scene, STATES, {1: "torque"})


def verify(path: Path) -> None:
    command = [str(files("rerun_cli") / "rerun"), "rrd", "verify", str(path)]
    subprocess.run(command, check=True, capture_output=True)


def read(path: Path) -> Recording:
    """Times [ns] and components of everything in a file that is not static, by entity."""
    times: dict[str, list[int]] = {}
    components: dict[str, dict[str, list[Any]]] = {}
    for chunk in RrdReader(path).stream():
        if chunk.is_static or "t" not in chunk.timeline_names:
            continue
        batch = chunk.to_record_batch()
        times.setdefault(chunk.entity_path, []).extend(batch.column("t").cast("int64").to_pylist())
        entity = components.setdefault(chunk.entity_path, {})
        for name in batch.schema.names[2:]:
            entity.setdefault(name, []).extend(batch.column(name).to_pylist())
    recording: Recording = {}
    for path_, entity_times in times.items():
        order = np.argsort(entity_times, kind="stable")
        recording[path_] = (
            np.array(entity_times)[order],
            {name: [values[i] for i in order] for name, values in components[path_].items()},
        )
    return recording


def scalars(recording: Recording, path: str) -> tuple[npt.NDArray[np.int64], FloatArray]:
    times_ns, components = recording[path]
    return times_ns, np.array(components["Scalars:scalars"], dtype=float)


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
            "clearance": rows["link_distance_m"] * 1e3,
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
    assert told["   6.501 s  remote is HOLD"] == "WARN"
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


def wait_for(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + DEADLINE_S
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


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


# In a viewer


def pixels(png: bytes) -> npt.NDArray[np.int16]:
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).astype(np.int16)


def count_of(image: npt.NDArray[np.int16], colour: tuple[int, int, int]) -> int:
    return int((np.abs(image - np.array(colour)).max(axis=2) <= 12).sum())


def retried(attempt: Callable[[], None]) -> None:
    """Once more if the software driver took the viewer down."""
    try:
        attempt()
    except ViewerCrashError:
        attempt()


@driverless
@pytest.mark.viewer
@pytest.mark.parametrize("dimension", [2, 3])
def test_the_viewer_shows_every_view(
    run: Any, spatial_run: Any, chain: Chain, dimension: int
) -> None:
    # Seconds with contact, so that every force is to be seen.
    batches = (run if dimension == 2 else spatial_run).batches(PASSAGES_NS)
    batches = [item for item in batches if 109_000 * MS < item[1] < 115_000 * MS]
    plots = {
        "Position error [mm]": (LOCAL_COLOUR, REMOTE_COLOUR),
        "Force [N]": (LOCAL_COLOUR, REMOTE_COLOUR),
        "Joint torque [N·m]": (LOCAL_COLOUR, REMOTE_COLOUR),
        "One-way delay [ms]": (LOCAL_COLOUR, REMOTE_COLOUR),
        "Greatest loop age [ms]": (REMOTE_COLOUR, RED),
        "Loop lateness [µs]": (LOCAL_COLOUR, REMOTE_COLOUR),
    }
    arms = {
        "Local · 2 joints": (LOCAL_COLOUR, REMOTE_COLOUR),
        "Remote · 3 joints": (REMOTE_COLOUR, LOCAL_COLOUR),
    }

    def attempt() -> None:
        with headless_viewer() as client:
            draw(client, picture_of(chain, dimension), batches)
            state = client.get_state()
            classes = {view.name: view.view_class for view in state.views}
            expected = dict.fromkeys(plots, "TimeSeries")
            expected |= dict.fromkeys(arms, f"{dimension}D")
            expected |= dict.fromkeys(
                ("Joint angles [rad]", "Joint speeds [rad/s]", "Clearance [mm]"), "TimeSeries"
            )
            expected |= {"Events": "TextLog", "Supervisor": "StateTimeline"}
            assert classes == expected
            assert [view.name for view in state.views if view.reports] == []
            [timeline] = [t for r in state.recordings for t in r.timelines if t.name == "t"]
            assert timeline.end == 9_999 * MS
            complaints = [
                entry.message
                for entry in client.get_logs()
                if entry.level != "INFO" and "Software rasterizer" not in entry.message
            ]
            assert complaints == []
            shots = {
                view.name: pixels(client.take_screenshot(view.view_id))
                for view in state.views
                if view.name in plots | arms
            }
        for name, (own, peer) in arms.items():
            assert count_of(shots[name], own) > 1000, name
            assert count_of(shots[name], peer) < 100, name
        for name, colours in plots.items():
            for colour in colours:
                assert count_of(shots[name], colour) > 300, (name, colour)

    retried(attempt)


@driverless
@pytest.mark.viewer
def test_a_screenshot_is_a_picture_of_the_size_asked_for(
    run: Any, chain: Chain, tmp_path: Path
) -> None:
    path = tmp_path / "run.png"
    screenshot(path, picture_of(chain), run.batches(PASSAGES_NS)[:60], 1280, 720)
    image = pixels(path.read_bytes())
    assert image.shape == (720, 1280, 3)
    assert count_of(image, LOCAL_COLOUR) > 300
    assert count_of(image, REMOTE_COLOUR) > 300
