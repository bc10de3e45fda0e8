"""The figure of a recording, drawn to a file and read back."""

from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.image import imread

from experiments import recording_figure
from experiments.recording_figure import PANELS, PIECES, SiteTrace
from experiments.simulation import Simulation
from site_runtime.session import load_session
from site_runtime.supervisor import State
from telemetry.rows import COLUMNS, RowArray

DEMO = Path(__file__).resolve().parents[2] / "experiments" / "demo.toml"
STATES = {state.value: state.name for state in State}


def trace_of(site: str, rows: RowArray) -> SiteTrace:
    return SiteTrace(site, rows["time_ns"] * 1e-9, {name: rows[name] for name in COLUMNS})


@pytest.fixture(scope="module")
def traces() -> list[SiteTrace]:
    run = Simulation(load_session(DEMO)).run(1.0)
    local = np.concatenate((run.local[:400], run.local[600:]))
    local["state"][500:600] = State.HOLD
    for rows, late_us in ((local, 60), (run.remote, 90)):
        rows["lateness_ns"] = 1000 * late_us
    return [trace_of("local", local), trace_of("remote", run.remote)]


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    figures: list[Figure] = []
    monkeypatch.setattr(recording_figure, "save", lambda figure, _: figures.append(figure))
    return figures


def draw(traces: list[SiteTrace], *names: str) -> None:
    recording_figure.recording_figure(Path("unused"), "a title", traces, STATES, names)


def lines(figure: Figure, panel: int) -> dict[str, np.ndarray]:
    return {str(line.get_label()): line.get_xydata() for line in figure.axes[panel].get_lines()}


def test_a_figure_has_ink_in_every_panel_and_the_same_bytes_twice(
    traces: list[SiteTrace], tmp_path: Path
) -> None:
    files = [tmp_path / name for name in ("a.png", "b.png")]
    for file in files:
        recording_figure.recording_figure(file, "a title", traces, STATES)
    first, second = (file.read_bytes() for file in files)
    assert first == second
    image = imread(files[0])[..., :3]
    for panel in np.array_split(image[60:, :1000], len(PANELS), axis=0):
        assert (np.ptp(panel, axis=2) > 0.2).sum() > 100


def test_every_value_is_drawn_and_a_gap_parts_the_curve(
    traces: list[SiteTrace], drawn: list[Figure]
) -> None:
    draw(traces, "torque", "force")
    force, torque = (lines(drawn[0], panel) for panel in (0, 1))
    assert set(torque) == {"local 1", "local 2", "remote 1", "remote 2", "remote 3"}
    assert np.array_equal(torque["remote 2"][:, 1], traces[1].fields["torque_nm"][:, 1])
    local = torque["local 1"]
    assert np.isnan(local[400, 1])
    assert np.array_equal(np.delete(local[:, 1], 400), traces[0].fields["torque_nm"][:, 0])
    assert np.array_equal(
        force["remote external"][:, 1],
        np.linalg.norm(traces[1].fields["external_force_n"], axis=1),
    )
    # 200 rows are missing
    [hatched] = drawn[0].axes[0].collections
    [box] = hatched.get_paths()
    assert box.get_extents().width == pytest.approx(0.201)


def test_states_are_bands_from_change_to_change(
    traces: list[SiteTrace], drawn: list[Figure]
) -> None:
    draw(traces, "states")
    axes = drawn[0].axes[0]
    assert [label.get_text() for label in axes.get_yticklabels()] == ["local", "remote"]
    bands = [path.get_extents() for c in axes.collections[:-1] for path in c.get_paths()]
    local = [(band.x0, band.x1) for band in bands if band.y0 == -0.4]
    time_s = traces[0].time_s
    assert local == [
        pytest.approx((time_s[first], time_s[last]))
        for first, last in ((0, 399), (400, 500), (500, 600), (600, len(time_s) - 1))
    ]
    words = [text.get_text() for text in axes.get_legend().get_texts()]
    assert words == ["engaged", "hold"]


def test_of_a_long_recording_no_spike_is_lost(drawn: list[Figure], traces: list[SiteTrace]) -> None:
    rows = 20 * PIECES + 7
    late_ns = np.full(rows, 50_000)
    late_ns[[0, 12_345, rows - 1]] = 9_000_000, 7_000_000, 8_000_000
    fields = {"sequence": np.arange(rows), "lateness_ns": late_ns}
    draw([SiteTrace("local", np.arange(rows) * 1e-3, fields)], "lateness")
    shown = lines(drawn[0], 0)["local"]
    assert len(shown) <= 2 * PIECES
    assert sorted(shown[shown[:, 1] > 50.0, 1]) == [7000.0, 8000.0, 9000.0]
    spike_s = shown[shown[:, 1] == 7000.0, 0][0]
    assert spike_s == pytest.approx(12.345, abs=0.021)


def test_an_age_far_beyond_the_certified_one_leaves_that_in_sight(
    traces: list[SiteTrace], drawn: list[Figure]
) -> None:
    draw(traces, "age")
    beyond = {**traces[1].fields, "loop_bound_s": np.full(len(traces[1].time_s), 9.0)}
    draw([traces[0], SiteTrace("remote", traces[1].time_s, beyond)], "age")
    assert [figure.axes[0].get_yscale() for figure in drawn] == ["linear", "symlog"]
    assert "certified" in lines(drawn[0], 0)


def test_one_site_alone_and_a_single_row_are_drawn(traces: list[SiteTrace], tmp_path: Path) -> None:
    alone = traces[1].within(0.5, 0.501)
    assert len(alone.time_s) == 1
    file = tmp_path / "a.png"
    recording_figure.recording_figure(file, "a title", [alone], STATES)
    assert imread(file).shape[:2] == (1134, 1260)


def test_the_error_between_the_sites_is_at_one_time(
    traces: list[SiteTrace], drawn: list[Figure]
) -> None:
    draw(traces, "error")
    apart = lines(drawn[0], 0)["|local − remote|"]
    row = 100
    local_m = traces[0].fields["position_m"] - traces[0].fields["offset_m"]
    then = np.searchsorted(traces[1].time_s, traces[0].time_s[row])
    apart_mm = 1e3 * np.linalg.norm(local_m[row] - traces[1].fields["position_m"][then])
    assert apart[row, 1] == pytest.approx(apart_mm)
