"""The plant that fakes share: its file's layout, its coordinates, its process."""

import signal
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from site_runtime.keys import SiteId
from site_runtime.parts import robot_of
from site_runtime.session import load_session
from tests.fakes.plant import MAGIC, PARALLELOGRAM, SIZE, Plant, PlantMemory, PlantState
from tests.fakes.quanser_hardware import SharedPlant

SESSION = Path(__file__).parents[2] / "experiments" / "figure_5.toml"
START = np.array([0.807, 1.629])
OFFSET = np.array([0.2, -1.7])


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Callable[[float], None]:
    """Turns the plant's time on by so many seconds."""
    now = [5_000_000_000]
    monkeypatch.setattr(time, "monotonic_ns", lambda: now[0])

    def advance(duration_s: float) -> None:
        now[0] += round(duration_s * 1e9)

    return advance


@pytest.fixture
def plant(tmp_path: Path, clock: Callable[[float], None]) -> Iterator[Plant]:
    session = load_session(SESSION)
    plant = Plant(session, SiteId.LOCAL, tmp_path / "plant", PARALLELOGRAM, OFFSET)
    yield plant
    plant.close()


def test_the_layout_is_the_one_that_fakes_in_c_rely_on(tmp_path: Path) -> None:
    path = tmp_path / "plant"
    memory = PlantMemory.create(path, 4)
    assert not memory.running
    rows = np.arange(1.0, 5.0)
    memory.publish(PlantState(rows, 10.0 * rows, np.arange(6.0) - 7.0, -77))
    memory.write_torque(2, [0.25, 0.5])
    image = path.read_bytes()
    assert len(image) == SIZE
    assert struct.unpack_from("<QQqII", image, 0) == (MAGIC, 2, -77, 4, 1)
    assert struct.unpack_from("<5d", image, 32) == (1.0, 2.0, 3.0, 4.0, 0.0)
    assert struct.unpack_from("<5d", image, 160) == (10.0, 20.0, 30.0, 40.0, 0.0)
    assert struct.unpack_from("<6d", image, 288) == (-7.0, -6.0, -5.0, -4.0, -3.0, -2.0)
    assert struct.unpack_from("<5d", image, 512) == (0.0, 0.0, 0.25, 0.5, 0.0)
    stamps = struct.unpack_from("<5q", image, 640)
    assert stamps[:2] == (0, 0)
    assert stamps[2] > 0
    assert stamps[4] == 0
    memory.end()
    assert not memory.running
    memory.close()


def test_a_file_of_something_else_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "other"
    path.write_bytes(bytes(SIZE))
    with pytest.raises(ValueError, match="not the file of a plant"):
        PlantMemory(path)


def test_positions_are_in_device_coordinates(plant: Plant) -> None:
    plant.step()
    state = plant.memory.read()
    np.testing.assert_allclose(PARALLELOGRAM @ state.position_rad + OFFSET, START, atol=1e-12)
    assert state.stamp_ns == time.monotonic_ns()


def test_a_torque_on_one_motor_does_the_work_that_its_own_coordinate_says(
    plant: Plant, clock: Callable[[float], None]
) -> None:
    """The second motor alone: τ_q = A⁻ᵀ τ_d pushes the joints by (1, 1), not by (0, 1)."""
    session = load_session(SESSION)
    plant.step()
    plant.memory.write_torque(1, [0.1])
    plant.step()
    clock(0.001)
    plant.step()
    q_dot = PARALLELOGRAM @ plant.memory.read().velocity_rad_s
    robot = robot_of(session, SiteId.LOCAL)
    friction = session.local.device.coulomb_friction_nm  # type: ignore[attr-defined]
    push = robot.terms(START, np.zeros(2)).M @ q_dot / 0.001
    np.testing.assert_allclose(push, [0.1 - friction] * 2, rtol=0.05)


def test_the_hand_waits_until_the_robot_is_driven(
    plant: Plant, clock: Callable[[float], None]
) -> None:
    for _ in range(100):
        clock(0.04)
        plant.step()
    assert not plant.memory.read().wrench.any()  # the script pushes from its second 1 to 9
    plant.memory.write_torque(0, [1e-6])
    plant.step()
    for _ in range(75):
        clock(0.04)
        plant.step()
    wrench = plant.memory.read().wrench
    assert wrench[0] == pytest.approx(1.6 * np.sin(np.pi * 2.0 / 8.0) ** 2, rel=1e-3)
    assert not wrench[1:].any()


def test_torque_ends_at_its_end_whoever_wrote_it(
    plant: Plant, clock: Callable[[float], None], tmp_path: Path
) -> None:
    board = SharedPlant(str(tmp_path / "plant"), 0, 1)
    assert not board.torque_has_ended()
    plant.memory.write_torque(0, [0.1, 0.2])
    board.end_torque_at(time.monotonic_ns() + 2_000_000)
    plant.step()
    np.testing.assert_array_equal(plant.memory.torque_nm(), [0.1, 0.2])
    assert not plant.memory.torque_free_since_ns().any()
    clock(0.002)
    assert board.torque_has_ended()
    ended_ns = time.monotonic_ns()
    for _ in range(3):
        plant.step()
        clock(0.001)
    np.testing.assert_array_equal(plant.memory.torque_nm(), [0.0, 0.2])
    np.testing.assert_array_equal(plant.memory.torque_free_since_ns(), [ended_ns, 0])
    board.end_torque_at(None)
    plant.step()
    np.testing.assert_array_equal(plant.memory.torque_nm(), [0.1, 0.2])
    assert not plant.memory.torque_free_since_ns().any()


@pytest.mark.processes
@pytest.mark.parametrize("site", SiteId)
def test_the_process_runs_until_told_to_end(tmp_path: Path, site: SiteId) -> None:
    path = tmp_path / "plant"
    command = [sys.executable, "-m", "tests.fakes.plant", str(SESSION), "--site", site.label]
    process = subprocess.Popen([*command, "--file", str(path)], cwd=SESSION.parents[1])
    try:
        while not (path.exists() and PlantMemory(path).running):
            assert process.poll() is None
            time.sleep(0.01)
        memory = PlantMemory(path)
        first = memory.read()
        while memory.read().stamp_ns - first.stamp_ns < 50_000_000:
            assert process.poll() is None
        state = memory.read()
        assert len(state.position_rad) == (2 if site is SiteId.LOCAL else 4)
        np.testing.assert_array_equal(state.position_rad, first.position_rad)  # nobody drives it
        process.send_signal(signal.SIGTERM)
        assert process.wait(timeout=20) == 0
        assert not memory.running
        memory.close()
    finally:
        process.kill()
        process.wait()
