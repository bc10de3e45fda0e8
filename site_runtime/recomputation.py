"""A recorded run computed again, by the very code that ran: what it read and heard goes in.

Of a run recorded whole, every tick is computed from the device's readings, the packets as they
arrived and the operator's requests; of a part of one, the command of every tick by itself.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt

from hardware.interface import Device, DeviceError, DeviceState, JointStops
from site_runtime.assembly import Surroundings
from site_runtime.clock import ManualClock
from site_runtime.guard import GuardError
from site_runtime.keys import SiteId
from site_runtime.operator_requests import CLUTCH_BUTTON, OperatorRequests
from site_runtime.parts import robot_of
from site_runtime.session import Session
from site_runtime.site import LateError, Site
from site_runtime.supervisor import STOPPED, State
from telemetry.recording import Recording
from telemetry.row_ring import ARRIVAL_BYTES
from telemetry.rows import RowArray
from telemetry.stream import decode_batch

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
Build = Callable[[Session, Surroundings], Site]

MEASURED: Final = ("lateness_ns", "duration_ns", "read_ns", "step_ns", "write_ns", "sent_ns")
"""Columns that tell the time things took, which is not computed."""

BY_LAW: Final = (
    "cut",
    "torque_nm",
    "position_m",
    "velocity_m_s",
    "coupling_force_n",
    "sub_task_error_rad_s",
)
"""Columns that follow from a reading and the point to follow."""

_OWN_FAILURES: Final = (GuardError.__name__, LateError.__name__)
_FAULT: Final = "FAULT: "
_LOOK_TICKS: Final = 500


@dataclass(frozen=True, slots=True)
class Recomputed:
    """Rows as they were recorded and as computed again; `columns` are those that were computed."""

    recorded: RowArray
    computed: RowArray
    columns: tuple[str, ...]

    @property
    def differing(self) -> dict[str, int]:
        """In how many rows each column that differs has other bits."""
        found = {name: int(self.differs(name).sum()) for name in self.columns}
        return {name: count for name, count in found.items() if count}

    def differs(self, name: str) -> BoolArray:
        """Rows (r,) in which a column has other bits."""
        recorded, computed = _bytes(self.recorded[name]), _bytes(self.computed[name])
        different: BoolArray = (recorded != computed).any(axis=1)
        return different


def whole(recording: Recording) -> str:
    """Return why a run cannot be computed from its start, empty if it can be."""
    rows, arrivals = recording.rows, recording.arrivals
    if rows["sequence"][0] != 0:
        return f"it begins with row {rows['sequence'][0]}"
    if recording.gaps:
        return f"it has {len(recording.gaps)} gaps, the first at row {recording.gaps[0].first}"
    if not len(arrivals):
        return "it holds no arrivals"
    if not np.array_equal(arrivals["number"], np.arange(len(arrivals))):
        return "some arrivals are missing"
    return ""


def recompute(
    recording: Recording,
    session: Session,
    build: Build,
    progress: Callable[[int], None] = lambda _: None,
) -> Recomputed:
    """Compute a run, recorded whole, tick by tick; `progress` gets the ticks done so far.

    A session other than the recorded one says what it would have commanded at the same readings
    and packets. Ends with the row where the computed run would stop and the recorded did not.
    """
    rows, metadata = recording.rows, recording.metadata
    link, device = RecordedLink(recording), RecordedDevice(recording)
    clock, requests = ManualClock(int(rows["stamp_ns"][0])), OperatorRequests()
    batches: list[bytes] = []
    site = build(
        replace(session, digest=int(metadata["digest"], 16)),  # of the packets that arrived
        Surroundings(
            link=link,
            clock=clock,
            session_start_ns=int(rows["stamp_ns"][0]) - int(rows["time_ns"][0]),
            epoch=int(metadata["epoch"]),
            publish=batches.append,
            requests=requests,
            in_place_of=device.in_place_of,
        ),
    )
    site.open()
    for tick, row in enumerate(rows):
        clock.sleep_until_ns(int(row["stamp_ns"]))
        link.tick = device.tick = tick
        requests.ask(int(row["requests"]) & ~CLUTCH_BUTTON)
        site.missed = int(row["missed"])
        site.tick(int(row["lateness_ns"]))
        site.telemetry.flush()
        if tick % _LOOK_TICKS == 0:
            progress(tick)
    site.telemetry.drain()
    computed = np.concatenate([rows[:0], *(decode_batch(batch).rows for batch in batches)])
    columns = tuple(name for name in rows.dtype.names or () if name not in MEASURED)
    return Recomputed(rows[: len(computed)], computed, columns)


def recompute_law(recording: Recording, session: Session, build: Build) -> Recomputed:
    """Compute the command of every driven row by itself, whatever part of a run it is of.

    The guard's limit on torque rates starts from the row before. Where that is missing, the row is
    left out.
    """
    rows, metadata = recording.rows, recording.metadata
    identity = SiteId[metadata["site"].upper()]
    device, robot = RecordedDevice(recording), robot_of(session, identity)
    surroundings = Surroundings(
        link=RecordedLink(recording),
        clock=ManualClock(),
        session_start_ns=0,
        epoch=1,
        publish=lambda _: None,
        in_place_of=device.in_place_of,
    )
    site = build(session, surroundings)
    driven = np.isfinite(rows["engaged_s"])
    follows = np.concatenate(([False], np.diff(rows["sequence"].astype(np.int64)) == 1))
    computed, kept = rows.copy(), []
    for i in np.flatnonzero(driven).tolist():
        row, out = rows[i], computed[i]
        if follows[i] and not driven[i - 1]:
            site.guard.restart()
        device.tick = i
        reading = device.reading()
        site.guard.reading(reading)
        terms = robot.terms(reading.position_rad, reading.velocity_rad_s)
        command = site.command(
            terms,
            row["peer_position_m"].copy(),
            float(row["force_share"]),
            float(row["engaged_s"]),
        )
        out["cut"] = site.guard.cut
        out["torque_nm"] = command.torque_nm
        out["position_m"] = terms.X
        out["velocity_m_s"] = terms.X_dot
        out["coupling_force_n"] = command.coupling_force_n
        out["sub_task_error_rad_s"] = command.sub_task_error_rad_s
        if follows[i]:
            kept.append(i)
    return Recomputed(rows[kept], computed[kept], BY_LAW)


class RecordedLink:
    """The link as it was: brings at each `tick` what it brought then; what is sent is dropped."""

    def __init__(self, recording: Recording) -> None:
        self.tick = 0
        arrivals = recording.arrivals
        self._data = arrivals["data"]
        self._lengths = np.minimum(arrivals["length"], ARRIVAL_BYTES)
        sequence = recording.rows["sequence"]
        self._ends = np.searchsorted(arrivals["row"], sequence, side="right").tolist()
        self._starts = np.searchsorted(arrivals["row"], sequence, side="left").tolist()

    def send(self, data: bytes) -> bool:
        """Take it for sent."""
        return True

    def receive(self) -> list[bytes]:
        """Return what arrived for this tick."""
        return [
            self._data[i, : self._lengths[i]].tobytes()
            for i in range(self._starts[self.tick], self._ends[self.tick])
        ]

    def peer_present(self) -> bool:
        """Whether the far end is there: it was then."""
        return False

    def close(self) -> None:
        """Leave."""


class RecordedDevice:
    """The device as it was: reads at each `tick` what it read then, and fails where it failed."""

    def __init__(self, recording: Recording) -> None:
        self.tick = 0
        self.joints = recording.rows["q"].shape[1]
        self.joint_stops = JointStops.none(self.joints)
        self._rows = recording.rows
        self._dimension = recording.rows["position_m"].shape[1]
        state = recording.rows["state"]
        stopped = np.isin(state, list(STOPPED))
        before = np.concatenate(([False], stopped[:-1]))
        self._stopped = stopped
        self._failing = (state == State.FAULT) & ~before
        self._told = {
            event.stamp_ns: event.text.removeprefix(_FAULT)
            for event in recording.events
            if event.text.startswith(_FAULT)
        }

    def in_place_of(self, device: Device) -> Device:
        """Stand in for the session's own device, which is never opened."""
        self.joint_stops = device.joint_stops
        return self

    def open(self) -> None:
        """Connect; a reset that failed then fails again."""
        if self._stopped[self.tick] and self._stopped[min(self.tick + 1, len(self._rows) - 1)]:
            raise DeviceError("it could not be opened")

    def enable(self) -> None:
        """Switch the outputs on."""
        self._fail()

    def read(self) -> DeviceState:
        """Return what was read."""
        if not self._rows["read_ns"][self.tick]:
            self._fail()
        return self.reading()

    def reading(self) -> DeviceState:
        """Return what was read; the wrench's part that no row holds is zero."""
        row = self._rows[self.tick]
        wrench = np.zeros(6)
        wrench[: self._dimension] = row["external_force_n"]
        return DeviceState(
            row["q"].copy(),
            row["q_dot"].copy(),
            wrench,
            int(row["stamp_ns"]),
            bool(row["requests"] & CLUTCH_BUTTON),
        )

    def write(self, torque_nm: FloatArray) -> None:
        """Take the torque."""
        self._fail()

    def stop(self) -> None:
        """Switch the outputs off."""

    def close(self) -> None:
        """Disconnect."""

    def _fail(self) -> None:
        """Fail if it was the device that failed in this tick, not the site itself."""
        if not self._failing[self.tick]:
            return
        told = self._told.get(int(self._rows["stamp_ns"][self.tick]), "")
        if told.partition(":")[0] not in _OWN_FAILURES:
            raise DeviceError(told)


def _bytes(values: npt.NDArray[np.generic]) -> npt.NDArray[np.uint8]:
    whole = np.ascontiguousarray(values)
    return whole.view(np.uint8).reshape(len(whole), -1)
