"""The driver "quanser" on the fake board, under a clock that the test moves on."""

from typing import Any

import numpy as np

from hardware.interface import DeviceState, FloatArray
from hardware.quanser import QuanserDevice, QuanserSettings
from tests.fakes.quanser_hardware import Board, FreeJoints, ManualTime, Robot, connect

MODULE = "tests.fakes.quanser_hardware"
TICK_S = 0.001


def settings_of(robot: Robot, **changes: Any) -> QuanserSettings:
    """Settings that say of the robot what is true of it."""
    keys: dict[str, Any] = {
        "board_type": "q8_usb",
        "module": MODULE,
        "encoder_channels": robot.encoder_channels,
        "analog_channels": robot.analog_channels,
        "enable_channels": robot.enable_channels,
        "counts_per_rad": robot.counts_per_rad,
        "encoder_signs": robot.encoder_signs,
        "motor_signs": robot.motor_signs,
        "amplifier_gain_a_per_v": robot.amplifier_gain_a_per_v,
        "torque_constant_nm_per_a": robot.torque_constant_nm_per_a,
        "drive_matrix": ((1.0, 0.0), (-1.0, 1.0)),
        "reference_position_rad": (0.4, -0.7),
        "peak_a": (2.0, 2.0),
        "continuous_a": (1.0, 0.8),
        "thermal_time_s": (2.0, 3.0),
        "torque_ramp_s": 0.0,
    }
    return QuanserSettings(**(keys | changes))


class QuanserBench:
    """A fake board in the computer, and a device on it that nobody has opened."""

    def __init__(self, robot: Robot | None = None, **changes: Any) -> None:
        self.robot = robot or Robot()
        self.time = ManualTime()
        self.plant = FreeJoints(len(self.robot.encoder_channels))
        self.board = connect(Board(self.robot, self.plant, self.time))
        self.settings = settings_of(self.robot, **changes)
        self.device = QuanserDevice(self.settings, self.time)
        self.drive = np.array(self.settings.drive_matrix)

    def tick(self) -> None:
        self.board.pass_time(TICK_S)

    def wait(self, seconds: float) -> None:
        """Let time pass in which the site does nothing."""
        for _ in range(round(seconds / TICK_S)):
            self.tick()

    def run(self, ticks: int, torque_nm: FloatArray | None = None) -> list[DeviceState]:
        states = []
        for _ in range(ticks):
            self.tick()
            states.append(self.device.read())
            if torque_nm is not None:
                self.device.write(torque_nm)
        return states

    def torque_nm(self) -> FloatArray:
        """What the motors push the robot's joints with: τ_φ = Aᵀ τ_q."""
        return np.linalg.solve(self.drive.T, np.array(self.board.torque_nm()))

    def position_rad(self) -> FloatArray:
        """Where the robot's joints are, if it was opened where the plant begins."""
        moved = np.array(self.plant.angle_rad()) - 0.3
        return np.array(self.settings.reference_position_rad) + self.drive @ moved
