"""Plausible rows of two planar arms, by simple trigonometry, for tests of what shows them."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pytest

from telemetry.rows import RowArray, row_dtype
from telemetry.stream import Batch

FloatArray = npt.NDArray[np.float64]

LINK_M = 0.38
MS = 1_000_000


def planar_chain(q: FloatArray) -> FloatArray:
    """Points (r, n + 1, 3) of planar arms with equal links."""
    angles = np.cumsum(q, axis=1)
    steps = LINK_M * np.stack((np.cos(angles), np.sin(angles), np.zeros_like(angles)), axis=2)
    return np.concatenate((np.zeros((len(q), 1, 3)), np.cumsum(steps, axis=1)), axis=1)


def inverse_2r(x: FloatArray, y: FloatArray) -> FloatArray:
    bend = np.arccos(np.clip((x**2 + y**2) / (2 * LINK_M**2) - 1.0, -1.0, 1.0))
    return np.column_stack((np.arctan2(y, x) - bend / 2, bend))


def inverse_3r(x: FloatArray, y: FloatArray, tilt: FloatArray) -> FloatArray:
    """Joints whose last link points along `tilt` [rad]."""
    q = inverse_2r(x - LINK_M * np.cos(tilt), y - LINK_M * np.sin(tilt))
    return np.column_stack((q, tilt - q.sum(axis=1)))


@dataclass(frozen=True)
class Run:
    """Rows of both sites and the batches they travel in."""

    local: RowArray
    remote: RowArray

    def batches(
        self, offsets_ns: tuple[int, int] = (0, 0), batch_rows: int = 50
    ) -> list[tuple[Batch, int]]:
        """Batches in order of arrival; clock and passage put this many ns on the stamps."""
        items = []
        for site, rows in enumerate((self.local, self.remote)):
            joints, dimension = rows["q"].shape[1], rows["position_m"].shape[1]
            for start in range(0, len(rows), batch_rows):
                part = rows[start : start + batch_rows]
                arrival_ns = int(part["stamp_ns"][-1]) + offsets_ns[site]
                items.append((Batch(site, joints, dimension, 7, 1, part), arrival_ns))
        return sorted(items, key=lambda item: item[1])


def make_run(seconds: float = 12.0, dimension: int = 2, seed: int = 3) -> Run:
    """A session: alignment, engagement, contact with a wall, an outage, engagement again."""
    random = np.random.default_rng(seed)
    count = round(seconds * 1000)
    t = np.arange(count) * 1e-3

    def hand(at: FloatArray) -> tuple[FloatArray, FloatArray]:
        return 0.46 + 0.11 * np.cos(0.9 * at + 0.4), 0.28 + 0.16 * np.sin(1.3 * at)

    delay_s = {
        "local": 0.1 + 0.05 * np.sin(t) + random.uniform(0, 0.004, count),
        "remote": 0.08 + 0.04 * np.sin(0.7 * t + 1.0) + random.uniform(0, 0.004, count),
    }
    delay_s["local"][t > 0.62 * seconds] += 0.11
    paths = {"local": np.column_stack(hand(t)), "remote": np.column_stack(hand(t - 0.12))}
    paths["remote"][:, 0] = np.minimum(paths["remote"][:, 0], 0.53 + 0.004 * np.sin(9 * t))
    joints = {
        "local": inverse_2r(*paths["local"].T),
        "remote": inverse_3r(*paths["remote"].T, 0.5 * np.sin(0.8 * t) - 0.3),
    }
    rows = {}
    for site, peer in (("local", "remote"), ("remote", "local")):
        q, x = joints[site], paths[site]
        row = np.zeros(count, row_dtype(q.shape[1], dimension))
        row["sequence"] = np.arange(count)
        row["time_ns"] = np.arange(count) * MS
        row["stamp_ns"] = row["time_ns"] + (5_000 * MS if site == "local" else 91_000 * MS)
        late_us = random.gamma(2.0, 9.0, count)
        late_us[random.integers(0, count, count // 300)] += 220.0
        row["lateness_ns"] = (late_us * 1e3).astype(int)
        row["duration_ns"] = random.integers(90_000, 130_000, count)
        row["state"] = np.select([t < 0.5, t < 2.0, (t > 6.5) & (t < 7.4)], [0, 1, 3], 2)
        row["peer_state"] = row["state"]
        row["q"], row["q_dot"] = q, np.gradient(q, 1e-3, axis=0)
        row["position_m"][:, :2] = x
        row["velocity_m_s"][:, :2] = np.gradient(x, 1e-3, axis=0)
        seen = t - delay_s[site]
        for axis in range(2):
            row["peer_position_m"][:, axis] = np.interp(seen, t, paths[peer][:, axis])
        row["peer_position_m"][seen < 0] = np.nan
        row["coupling_force_n"] = -40.0 * np.nan_to_num(row["position_m"] - row["peer_position_m"])
        row["one_way_delay_s"] = np.where(seen < 0, np.nan, delay_s[site])
        row["round_trip_s"] = delay_s["local"] + delay_s["remote"]
        row["round_trip_s"][t < 0.4] = np.nan
        row["loop_bound_s"] = row["round_trip_s"] + 0.03
        row["certified_round_trip_s"] = 0.4
        row["clock_uncertainty_ns"] = -1
        row["missed"] = np.where(t > 4.2, 3, 0)
        row["rejected"][:, 4] = np.where(t > 8.3, 2, 0)
        rows[site] = row
    pressed = np.maximum(np.column_stack(hand(t - 0.12))[:, 0] - paths["remote"][:, 0], 0.0)
    rows["remote"]["external_force_n"][:, 0] = -200.0 * pressed
    rows["local"]["external_force_n"][:, 0] = 140.0 * pressed + 1.5 * np.sin(2 * t)
    rows["local"]["external_force_n"][:, 1] = 1.5 * np.cos(2 * t)
    for row in rows.values():
        force = row["external_force_n"] + row["coupling_force_n"]
        chain = planar_chain(row["q"])
        arms = chain[:, -1:, :2] - chain[:, :-1, :2]
        row["torque_nm"] = -(arms[..., 0] * force[:, None, 1] - arms[..., 1] * force[:, None, 0])
        row["cut"] = np.where(np.abs(row["torque_nm"]).max(axis=1) > 2.5, 1, 0)
    return Run(rows["local"], rows["remote"])


@pytest.fixture(scope="session")
def chain() -> Callable[[FloatArray], FloatArray]:
    return planar_chain


@pytest.fixture(scope="session")
def run() -> Run:
    return make_run()


@pytest.fixture(scope="session")
def spatial_run() -> Run:
    return make_run(dimension=3)
