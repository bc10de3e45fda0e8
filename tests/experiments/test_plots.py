"""The studies' figures, drawn to files and read back."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from experiments import plots
from experiments.case import Case, Outcome, read_outcome, run_case

Draw = Callable[[Path], None]


@pytest.fixture(scope="module")
def avoiding(tmp_path_factory: pytest.TempPathFactory) -> Outcome:
    """A fraction of a second beside an obstacle."""
    case = Case("avoiding", "figure_3.toml", 0.2)
    file = tmp_path_factory.mktemp("plots") / "avoiding.parquet"
    file.write_bytes(run_case(case))
    return read_outcome(case, file)


@pytest.fixture
def draw_sub_task(avoiding: Outcome) -> Draw:
    return lambda file: plots.sub_task_figure(file, avoiding, avoiding, "a sub-task")


@pytest.fixture
def draw_synchronisation(avoiding: Outcome) -> Draw:
    return lambda file: plots.synchronisation_figure(file, avoiding, "a title")


@pytest.mark.parametrize(
    ("drawing", "width", "height", "rows", "columns"),
    [
        ("draw_sub_task", 1440, 666, 2, 4),
        ("draw_synchronisation", 1080, 594, 2, 2),
    ],
)
def test_a_figure_has_its_size_and_ink_in_every_panel_and_the_same_bytes_twice(
    drawing: str,
    width: int,
    height: int,
    rows: int,
    columns: int,
    tmp_path: Path,
    request: pytest.FixtureRequest,
) -> None:
    draw: Draw = request.getfixturevalue(drawing)
    files = [tmp_path / name for name in ("a.png", "b.png")]
    for file in files:
        draw(file)
    first, second = (file.read_bytes() for file in files)
    assert first == second
    image = imread(files[0])[..., :3]
    assert image.shape == (height, width, 3)
    for across in np.array_split(image, rows, axis=0):
        for panel in np.array_split(across, columns, axis=1):
            coloured = np.ptp(panel, axis=2) > 0.2
            assert coloured.sum() > 100


def test_panels_are_counted_row_by_row(tmp_path: Path) -> None:
    figure, axes = plots.panels(2, 3, (6.0, 4.0))
    assert len(axes) == 6
    assert axes[0].get_subplotspec().rowspan.start == 0  # type: ignore[union-attr]
    assert axes[3].get_subplotspec().rowspan.start == 1  # type: ignore[union-attr]
    plots.save(figure, tmp_path / "empty.png")
    assert imread(tmp_path / "empty.png").shape[:2] == (360, 540)


def test_curves_are_the_columns_over_time() -> None:
    time_s = np.linspace(0.0, 1.0, 11)
    longer, shorter = np.arange(1.0, 14.0), np.arange(5.0)
    _, (axes,) = plots.panels(1, 1, (3.0, 3.0))
    plots.curves(
        axes,
        time_s,
        [("longer", longer, plots.LOCAL), ("shorter", shorter, plots.REMOTE)],
        "a title",
        logarithmic=True,
    )
    first, second = axes.get_lines()
    assert np.array_equal(first.get_xydata(), np.column_stack([time_s, longer[:11]]))
    assert np.array_equal(second.get_xydata(), np.column_stack([time_s[:5], shorter]))
    assert (first.get_color(), second.get_color()) == (plots.LOCAL, plots.REMOTE)
    assert axes.get_yscale() == "log"
    assert axes.get_title() == "a title"
    legend = axes.get_legend()
    assert legend is not None
    assert [text.get_text() for text in legend.get_texts()] == ["longer", "shorter"]


def test_a_curve_without_a_label_needs_no_legend() -> None:
    _, (axes,) = plots.panels(1, 1, (3.0, 3.0))
    plots.curves(axes, np.arange(3.0), [("", np.ones(3), plots.LOCAL)], "a title")
    assert axes.get_legend() is None
    assert axes.get_yscale() == "linear"


def test_the_stroboscope_shows_arm_way_and_obstacle(avoiding: Outcome) -> None:
    _, (axes,) = plots.panels(1, 1, (3.0, 3.0))
    plots.stroboscope(axes, avoiding, "a title")
    *arms, local, remote = axes.get_lines()
    assert len(arms) == 14
    for arm in arms:
        x_m, y_m = np.asarray(arm.get_xydata()).T
        assert np.hypot(np.diff(x_m), np.diff(y_m)) == pytest.approx([0.38] * 3)
    ends = avoiding.vector("remote_position")
    assert np.asarray(arms[0].get_xydata())[-1] == pytest.approx(ends[0])
    assert np.asarray(arms[-1].get_xydata())[-1] == pytest.approx(ends[-1])
    assert np.array_equal(remote.get_xydata(), ends)
    assert np.array_equal(local.get_xydata(), avoiding.vector("local_position"))
    (obstacle,) = avoiding.case.session().remote.obstacles
    circles = [(patch.center, patch.radius) for patch in axes.patches]
    assert circles == [
        (obstacle.center_m, obstacle.collision_radius_m),
        (obstacle.center_m, obstacle.safe_radius_m),
    ]


def test_an_arm_that_does_not_move_is_drawn(avoiding: Outcome, tmp_path: Path) -> None:
    trace = avoiding.trace
    still = replace(trace, columns={name: c[:1].repeat(3) for name, c in trace.columns.items()})
    _, (axes,) = plots.panels(1, 1, (3.0, 3.0))
    plots.stroboscope(axes, replace(avoiding, trace=still), "a title")
    assert len(axes.get_lines()) == 16
