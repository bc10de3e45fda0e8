"""What the tests of the dashboard share: a picture of the run, files read back, colours counted."""

import io
import subprocess
import time
from collections.abc import Callable
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image
from rerun.chunk import RrdReader

from telemetry.dashboard import ViewerCrashError
from telemetry.energy import EnergyTrace
from telemetry.picture import (
    LOCAL_COLOUR,
    REMOTE_COLOUR,
    CertificateView,
    ObstacleView,
    Picture,
    Scene,
    SiteView,
    UrdfView,
    WallView,
)
from telemetry.rows import RowArray

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
Chain = Callable[[FloatArray], FloatArray]
Recording = dict[str, tuple[IntArray, dict[str, list[Any]]]]

MS = 1_000_000
# The two sites' clocks read 5 s and 91 s at the start: these passages put both at 105 s.
PASSAGES_NS = (100_000 * MS, 14_000 * MS)
STATES = {
    0: "OFFLINE",
    1: "READY",
    2: "ENGAGED",
    3: "HOLD",
    4: "FAULT",
    5: "ALIGNING",
    6: "RELEASED",
    7: "EMERGENCY_STOP",
}
SCENE = Scene(
    (ObstacleView("obstacle", (0.22, -0.12, 0.0), 0.06, 0.12),),
    (WallView((0.54, 0.0, 0.0), (-1.0, 0.0, 0.0)),),
)
CERTIFICATE = CertificateView("Theorem B", 0.4, align_within_m=0.02)
DEADLINE_S = 30.0

driverless = pytest.mark.skipif(
    not any(
        icd
        for place in ("/usr/share/vulkan/icd.d", "/etc/vulkan/icd.d")
        for icd in Path(place).glob("*.json")
    ),
    reason="no Vulkan driver for the headless viewer (Debian: mesa-vulkan-drivers, libvulkan1)",
)


class Meter:
    """Says of rows what is easily checked: not energies, but what they were given."""

    def update(self, times_ns: IntArray, local: RowArray, remote: RowArray) -> EnergyTrace:
        every = slice(None, None, 10)
        x, y = local["position_m"][every], remote["position_m"][every]
        functional = np.column_stack((x[:, 0], y[:, 0], x[:, 1] - y[:, 1]))
        injected = np.column_stack((x[:, 0], y[:, 0]))
        dissipated = np.column_stack((x[:, 1], y[:, 1]))
        return EnergyTrace(times_ns[every], functional, injected, dissipated)


def first_angle(q: FloatArray) -> FloatArray:
    """Stand in for the clearance: what is easily checked of angles."""
    return q[:, 0]


def picture_of(
    chain: Chain,
    dimension: int = 2,
    scene: Scene = SCENE,
    urdfs: tuple[UrdfView | None, UrdfView | None] = (None, None),
) -> Picture:
    clearance = first_angle if scene.obstacles else None
    sites = (
        SiteView("local", LOCAL_COLOUR, chain, 2, dimension, urdfs[0], clearance),
        SiteView("remote", REMOTE_COLOUR, chain, 3, dimension, urdfs[1], clearance),
    )
    return Picture(sites, scene, STATES, {1: "torque"}, certificate=CERTIFICATE, meter=Meter)


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


def read_static(path: Path) -> dict[str, set[str]]:
    """Names of the components that a file has of each entity for all times."""
    found: dict[str, set[str]] = {}
    for chunk in RrdReader(path).stream():
        if chunk.is_static:
            names = chunk.to_record_batch().schema.names
            found.setdefault(chunk.entity_path, set()).update(names)
    return found


def scalars(recording: Recording, path: str) -> tuple[IntArray, FloatArray]:
    times_ns, components = recording[path]
    return times_ns, np.array(components["Scalars:scalars"], dtype=float)


def wait_for(condition: Callable[[], bool], deadline_s: float = DEADLINE_S) -> None:
    deadline = time.monotonic() + deadline_s
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


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
