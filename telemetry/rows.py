"""One row a tick: the one record that the stream, result files and the dashboard share."""

import struct
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, Final, Literal, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

RowArray: TypeAlias = npt.NDArray[np.void]

LAYOUT_VERSION: Final = 4
"""Raised whenever a field of `COLUMNS` is added, removed, moved or changes its meaning."""

NO_PEER_STATE: Final = 255
"""The `peer_state` of a site that has never heard its peer."""

MAX_JOINTS: Final = 16
_CODES: Final = {"|u1": "B", "<u2": "H", "<u4": "I", "<u8": "Q", "<i8": "q", "<f8": "d"}
DIMENSIONS: Final = (2, 3)

REJECT_REASONS: Final = (
    "length",
    "magic",
    "version",
    "dimension",
    "checksum",
    "non-finite",
    "site",
    "session",
    "epoch",
    "duplicate",
    "out of order",
    "stamp",
)
"""Why packets are refused, in the order of the `rejected` counts."""


class TelemetryError(Exception):
    """Telemetry that cannot be produced, read or shown as asked."""


class Column(NamedTuple):
    """What one field of a row is: its number format, its length, its unit and its meaning."""

    format: str
    axis: Literal["scalar", "joint", "task", "reason"]
    unit: str
    meaning: str


COLUMNS: Final[Mapping[str, Column]] = MappingProxyType(
    {
        "sequence": Column("<u8", "scalar", "1", "Rows written by this site before this one"),
        "stamp_ns": Column("<i8", "scalar", "ns", "Start of the tick on the site's own clock"),
        "time_ns": Column("<i8", "scalar", "ns", "Start of the tick since the session started"),
        "lateness_ns": Column("<i8", "scalar", "ns", "Wake-up after the tick's deadline"),
        "duration_ns": Column("<i8", "scalar", "ns", "Computing time of the previous tick"),
        "read_ns": Column("<u4", "scalar", "ns", "Tick's start until the device was read"),
        "step_ns": Column("<u4", "scalar", "ns", "Tick's start until the guard passed the torque"),
        "write_ns": Column("<u4", "scalar", "ns", "Tick's start until the torque was written"),
        "sent_ns": Column("<u4", "scalar", "ns", "Tick's start until a packet left; 0: none did"),
        "state": Column("u1", "scalar", "1", "Supervisor state of this site"),
        "peer_state": Column("u1", "scalar", "1", "Supervisor state of the peer; 255: none heard"),
        "requests": Column(
            "u1",
            "scalar",
            "1",
            "Asked for: 1 the device's clutch, 2 clutch, 4 emergency stop, 8 reset, 16 no lease",
        ),
        "cut": Column("<u2", "scalar", "1", "Limits the guard applied in this tick, one bit each"),
        "q": Column("<f8", "joint", "rad", "Joint angles"),
        "q_dot": Column("<f8", "joint", "rad/s", "Joint speeds"),
        "torque_nm": Column("<f8", "joint", "N·m", "Joint torques written to the device"),
        "position_m": Column("<f8", "task", "m", "End-effector position X"),
        "velocity_m_s": Column("<f8", "task", "m/s", "End-effector velocity"),
        "external_force_n": Column(
            "<f8", "task", "N", "Force of the hand or the environment on the robot"
        ),
        "coupling_force_n": Column("<f8", "task", "N", "Force −ΩP(e) of the coupling on the robot"),
        "peer_position_m": Column(
            "<f8", "task", "m", "Point to follow: the peer's, delayed, plus the offset; NaN: none"
        ),
        "offset_m": Column("<f8", "task", "m", "What the clutch put between the robots' points"),
        "force_share": Column(
            "<f8", "scalar", "1", "Share of stiffness and force ceiling in force: ramp, de-rating"
        ),
        "engaged_s": Column(
            "<f8", "scalar", "s", "Time since engagement; the sub-task ramps in with it; NaN: off"
        ),
        "used_stamp_ns": Column(
            "<i8", "scalar", "ns", "Stamp of the peer's sample in use, on its clock; 0: none"
        ),
        "used_arrival_ns": Column(
            "<i8", "scalar", "ns", "Tick at which that sample came, on this clock; 0: none"
        ),
        "clock_offset_ns": Column(
            "<i8", "scalar", "ns", "From the peer's clock to this one, an estimate; 0: none"
        ),
        "clock_uncertainty_ns": Column(
            "<i8", "scalar", "ns", "The estimate is right to within so much; -1: none"
        ),
        "one_way_delay_s": Column(
            "<f8", "scalar", "s", "Age of the peer sample in use, from the clock offset; NaN: none"
        ),
        "round_trip_s": Column(
            "<f8", "scalar", "s", "Age of the whole loop, measured on one clock; NaN: none"
        ),
        "loop_bound_s": Column(
            "<f8", "scalar", "s", "Greatest ages of late, both sites' together; NaN: none"
        ),
        "certified_round_trip_s": Column(
            "<f8", "scalar", "s", "Round trip the gains in use are proven stable for"
        ),
        "sub_task_error_rad_s": Column(
            "<f8", "scalar", "rad/s", "Norm of the sub-task error in the null space"
        ),
        "lost": Column("<u4", "scalar", "1", "Packets of the peer that never came, so far"),
        "late": Column("<u4", "scalar", "1", "Packets of the peer that came too late, so far"),
        "rejected": Column("<u4", "reason", "1", "Packets refused so far, by reason"),
        "missed": Column("<u4", "scalar", "1", "Ticks skipped because the loop was late, so far"),
    }
)

DERIVED: Final[Mapping[str, Column]] = MappingProxyType(
    {
        "manipulability": Column("<f8", "scalar", "m^(2z)", "det(J Jᵀ); zero at a singular pose"),
        "link_distance_m": Column(
            "<f8", "scalar", "m", "Smallest distance of the links to an obstacle; NaN: no obstacle"
        ),
        "midpoint_distance_m": Column(
            "<f8", "scalar", "m", "Smallest distance of a link's midpoint to one; NaN: no obstacle"
        ),
    }
)
"""What tables for people hold besides: it follows from `q`, so no tick works it out."""

DerivedColumns: TypeAlias = Mapping[str, npt.NDArray[np.float64]]
Derive: TypeAlias = Callable[[str, npt.NDArray[np.float64]], DerivedColumns]
"""Works out columns of `DERIVED`, (r,), from a site's name and its q (r, n)."""


def nothing_derived(site: str, q: npt.NDArray[np.float64]) -> DerivedColumns:
    """Derive nothing: of rows whose robot is not known."""
    return {}


def row_dtype(joints: int, dimension: int) -> np.dtype[np.void]:
    """Dtype of one row of a site with this many joints and task dimensions.

    Packed and little-endian, in the order of `COLUMNS`. TelemetryError outside 1 to 16 joints
    or 2 or 3 dimensions.
    """
    if not 1 <= joints <= MAX_JOINTS:
        raise TelemetryError(f"{joints} joints; rows hold 1 to {MAX_JOINTS}")
    if dimension not in DIMENSIONS:
        raise TelemetryError(f"{dimension} task dimensions; rows hold 2 or 3")
    length = {"joint": (joints,), "task": (dimension,), "reason": (len(REJECT_REASONS),)}
    fields: list[Any] = [
        (name, column.format, length.get(column.axis, ())) for name, column in COLUMNS.items()
    ]
    return np.dtype(fields)


def row_struct(dtype: np.dtype[np.void]) -> struct.Struct:
    """Return what packs the numbers of a row of this dtype, field after field."""
    codes = []
    for name in dtype.names or ():
        field = dtype[name]
        count = field.shape[0] if field.shape else 1
        codes.append(f"{count}{_CODES[field.base.str]}")
    return struct.Struct("<" + "".join(codes))
