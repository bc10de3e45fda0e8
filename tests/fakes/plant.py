"""The robot behind a bench's fakes: simulated in a process of its own, shared through a file.

``python -m tests.fakes.plant SESSION --site local|remote --file PATH`` simulates that site's robot
as SESSION describes it, touched by the session's operator or environment. The fakes of PHANToM,
Quanser and JR3 map the same file: they read positions and wrench, and write torques. All numbers
in it are in device coordinates d, with q = A d + b and τ_d = Aᵀ τ_q.

A torque may be given an end, as a board's watchdog has: the plant keeps it, whatever becomes of
the process that wrote the torque. And the plant says since when, by its own clock, it has applied
none.
"""

import argparse
import json
import mmap
import os
import signal
import struct
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from hardware.interface import ContactForce
from hardware.simulated import SimulatedDevice, SimulatedSettings
from local_site.operators import build_operator
from remote_site.environments import build_environment
from site_runtime.keys import SiteId
from site_runtime.parts import robot_of
from site_runtime.session import Session, load_session

FloatArray = npt.NDArray[np.float64]

ENVIRONMENT_VARIABLE = "FARHAND_FAKE_PLANT"
SIZE = 4096
MAGIC = 0x46485046414B4531
MOST_JOINTS = 16
RUNNING = 1
PERIOD_NS = 1_000_000

# Two motors on absolute angles of a parallelogram: q = P d + b.
PARALLELOGRAM = np.array([[1.0, 0.0], [-1.0, 1.0]])

_LAYOUT = {
    "magic": (0, "<u8", 1),
    "sequence": (8, "<u8", 1),
    "stamp_ns": (16, "<i8", 1),
    "joints": (24, "<u4", 1),
    "flags": (28, "<u4", 1),
    "position_rad": (32, "<f8", MOST_JOINTS),
    "velocity_rad_s": (160, "<f8", MOST_JOINTS),
    "wrench": (288, "<f8", 6),
    "torque_nm": (512, "<f8", MOST_JOINTS),
    "torque_stamp_ns": (640, "<i8", MOST_JOINTS),
    "torque_end_ns": (768, "<i8", MOST_JOINTS),  # 0: none
    "torque_free_since_ns": (896, "<i8", MOST_JOINTS),  # 0: torque is applied
}
_STATE = struct.Struct(f"<qII{2 * MOST_JOINTS + 6}d")
_STATE_BEGIN = _LAYOUT["stamp_ns"][0]
_STATE_END = _STATE_BEGIN + _STATE.size


@dataclass(frozen=True, slots=True)
class PlantState:
    """One state of the plant; positions and velocities (n,) in device coordinates."""

    position_rad: FloatArray
    velocity_rad_s: FloatArray
    wrench: FloatArray
    stamp_ns: int


class PlantMemory:
    """The file that a plant and its fakes share.

    One plant publishes, guarded by a sequence that is odd meanwhile; each fake writes the torque
    entries of its own joints. Relies on 8-byte stores that are whole and in order, as on x86.
    """

    def __init__(self, path: Path) -> None:
        descriptor = os.open(path, os.O_RDWR)
        try:
            self._map = mmap.mmap(descriptor, SIZE)
        finally:
            os.close(descriptor)
        self._fields = {
            name: np.frombuffer(self._map, dtype, count, offset)
            for name, (offset, dtype, count) in _LAYOUT.items()
        }
        if self._fields["magic"][0] != MAGIC:
            self.close()
            raise ValueError(f"{path} is not the file of a plant")

    @classmethod
    def create(cls, path: Path, joints: int) -> "PlantMemory":
        """Make the file of a plant of so many joints; readers see it whole or not at all."""
        image = bytearray(SIZE)
        for name, value in (("magic", MAGIC), ("joints", joints)):
            offset, dtype, count = _LAYOUT[name]
            np.frombuffer(image, dtype, count, offset)[0] = value
        half = path.with_name(f"{path.name}.new")
        half.write_bytes(image)
        half.replace(path)
        return cls(path)

    @property
    def joints(self) -> int:
        """Number of joints."""
        return int(self._fields["joints"][0])

    @property
    def running(self) -> bool:
        """Whether the plant has published and not ended."""
        return bool(self._fields["flags"][0] & RUNNING)

    def read(self) -> PlantState:
        """Return the newest state whole."""
        fields, n = self._fields, self.joints
        while True:
            before = int(fields["sequence"][0])
            state = PlantState(
                fields["position_rad"][:n].copy(),
                fields["velocity_rad_s"][:n].copy(),
                fields["wrench"].copy(),
                int(fields["stamp_ns"][0]),
            )
            if before % 2 == 0 and fields["sequence"][0] == before:
                return state

    def write_torque(self, first_joint: int, torque_nm: Sequence[float] | FloatArray) -> None:
        """Set the torques of the joints from `first_joint` on, as a fake does."""
        own = slice(first_joint, first_joint + len(torque_nm))
        self._fields["torque_nm"][own] = torque_nm
        self._fields["torque_stamp_ns"][own] = time.monotonic_ns()

    def torque_nm(self) -> FloatArray:
        """Return the torques of all joints (n,), zero where their end has come."""
        n = self.joints
        end_ns = self._fields["torque_end_ns"][:n]
        ended = (end_ns != 0) & (end_ns <= time.monotonic_ns())
        return np.where(ended, 0.0, self._fields["torque_nm"][:n])

    def note_applied(self, torque_nm: FloatArray) -> None:
        """Keep since when each joint has been without torque, as the plant does."""
        since_ns = self._fields["torque_free_since_ns"][: len(torque_nm)]
        free = torque_nm == 0.0
        since_ns[~free] = 0
        since_ns[free & (since_ns == 0)] = time.monotonic_ns()

    def torque_free_since_ns(self) -> npt.NDArray[np.int64]:
        """Return since when the plant has applied no torque to each joint (n,); 0: it does."""
        return self._fields["torque_free_since_ns"][: self.joints].copy()

    def publish(self, state: PlantState) -> None:
        """Set the state, as the plant does."""
        gap = [0.0] * (MOST_JOINTS - self.joints)
        numbers = (*state.position_rad, *gap, *state.velocity_rad_s, *gap, *state.wrench)
        image = _STATE.pack(state.stamp_ns, self.joints, RUNNING, *numbers)
        sequence = self._fields["sequence"]
        sequence[0] += 1
        self._map[_STATE_BEGIN:_STATE_END] = image  # at once: readers wait meanwhile
        sequence[0] += 1

    def end(self) -> None:
        """Say that the plant has ended."""
        self._fields["flags"][0] = 0

    def close(self) -> None:
        """Let go of the file."""
        self._fields.clear()
        self._map.close()


class Waiting:
    """A contact whose time begins when told; before that it is as at any negative time."""

    def __init__(self, contact: ContactForce) -> None:
        self._contact = contact
        self.start_s: float | None = None

    def force_n(
        self, time_s: float, position_m: FloatArray, velocity_m_s: FloatArray
    ) -> FloatArray:
        since_s = -1.0 if self.start_s is None else time_s - self.start_s
        return self._contact.force_n(since_s, position_m, velocity_m_s)


class Plant:
    """A simulated robot, free and with its outputs always on, stepped from torques in a file.

    Its positions are exact: encoders are the fakes'. Time of its contact begins with the first
    torque, so that the hand waits until the robot is driven.
    """

    def __init__(
        self, session: Session, site: SiteId, path: Path, matrix: FloatArray, offset: FloatArray
    ) -> None:
        settings = session.site(site).device
        if not isinstance(settings, SimulatedSettings):
            raise ValueError(
                f"{site.label}.device must be simulated: the plant is what it describes"
            )
        contact: ContactForce | None = (
            build_operator(session.local.operator, session.task.dimension)
            if site is SiteId.LOCAL
            else build_environment(session.remote.environment, session.task.dimension)
        )
        self._contact = None if contact is None else Waiting(contact)
        self._device = SimulatedDevice(
            robot_of(session, site),
            replace(settings, encoder_resolution_rad=0.0),
            self._contact,
            time.monotonic_ns,
            0,
            session.seed,
        )
        self._to_device = np.linalg.inv(matrix)
        self._offset = offset
        self._device.open()
        self._device.enable()
        self.memory = PlantMemory.create(path, self._device.joints)

    def step(self) -> None:
        """Advance the robot to now, publish it, take the newest torques."""
        state = self._device.read()
        self.memory.publish(
            PlantState(
                self._to_device @ (state.position_rad - self._offset),
                self._to_device @ state.velocity_rad_s,
                state.wrench,
                state.stamp_ns,
            )
        )
        motor_nm = self.memory.torque_nm()
        if self._contact is not None and self._contact.start_s is None and motor_nm.any():
            self._contact.start_s = state.stamp_ns * 1e-9
        self._device.write(self._to_device.T @ motor_nm)
        self.memory.note_applied(motor_nm)

    def close(self) -> None:
        """Say that the plant has ended, and let go of the file."""
        self._device.close()
        self.memory.end()
        self.memory.close()


def main(arguments: Sequence[str] | None = None) -> None:
    """Simulate until SIGTERM or SIGINT."""
    parser = argparse.ArgumentParser(prog="python -m tests.fakes.plant", description=__doc__)
    parser.add_argument("session", type=Path, help="session whose device is simulated")
    parser.add_argument("--site", choices=[site.label for site in SiteId], required=True)
    parser.add_argument("--file", type=Path, required=True, help="made here, shared with the fakes")
    parser.add_argument("--matrix", type=json.loads, help="A as JSON rows; left out, the identity")
    parser.add_argument("--offset", type=json.loads, help="b as JSON; left out, zeros")
    given = parser.parse_args(arguments)
    session = load_session(given.session)
    site = SiteId[given.site.upper()]
    n = robot_of(session, site).joints
    matrix = np.eye(n) if given.matrix is None else np.array(given.matrix, dtype=float)
    offset = np.zeros(n) if given.offset is None else np.array(given.offset, dtype=float)
    asked: list[int] = []
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda number, _: asked.append(number))
    plant = Plant(session, site, given.file, matrix, offset)
    try:
        deadline_ns = time.monotonic_ns()
        while not asked:
            plant.step()
            deadline_ns = max(deadline_ns + PERIOD_NS, time.monotonic_ns() - PERIOD_NS)
            time.sleep(max(0, deadline_ns - time.monotonic_ns()) * 1e-9)
    finally:
        plant.close()


if __name__ == "__main__":
    main()
