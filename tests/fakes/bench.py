"""Everything that a session's drivers need in place of hardware, for programs started from here.

``python -m tests.fakes.bench SESSION --site local|remote -- COMMAND…`` runs a command, such as
``farhand device-check``, among fakes. The session and the drivers stay as they are on a bench:
libHD.so is found on LD_LIBRARY_PATH, quanser.hardware on PYTHONPATH, the JR3 on the session's bus.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import numpy as np
import numpy.typing as npt

from hardware.interface import DeviceSettings
from hardware.jr3 import Jr3Settings
from hardware.phantom import PhantomSettings
from hardware.quanser import QuanserSettings
from hardware.serial_pair import SerialPairSettings
from site_runtime.keys import SiteId
from site_runtime.session import Session, load_session
from tests.fakes.hd import fake_hd
from tests.fakes.plant import ENVIRONMENT_VARIABLE, PARALLELOGRAM, PlantMemory

FloatArray = npt.NDArray[np.float64]

ROOT = Path(__file__).parents[2]
START_S = 30.0
PRIORITY = 85


@contextmanager
def started(command: Sequence[str], environment: dict[str, str]) -> Iterator[subprocess.Popen[str]]:
    """Run a module of the source tree until the end of the block.

    Before every other process, where that is allowed: hardware does not wait for a processor.
    """
    process = subprocess.Popen(
        [sys.executable, "-m", *command],
        cwd=ROOT,
        env=os.environ | environment,
        stdout=subprocess.PIPE,
        text=True,
    )
    with suppress(OSError):
        os.sched_setscheduler(process.pid, os.SCHED_FIFO, os.sched_param(PRIORITY))
    with process:
        try:
            yield process
        finally:
            process.terminate()


@contextmanager
def fakes(session: Session, site: SiteId, plant_session: Path | None) -> Iterator[dict[str, str]]:
    """Start the fakes of a site; yield the environment in which its programs find them.

    With `plant_session`, a session of the same robot simulated, they share a plant; without, each
    fake has one of its own.
    """
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        own = session.site(site)
        environment = _vendor_libraries(own.device, folder)
        if plant_session is not None:
            plant = folder / "plant"
            matrix, offset = device_coordinates(own.device)
            command = ["tests.fakes.plant", str(plant_session), "--site", site.label]
            command += ["--file", str(plant), f"--matrix={matrix.tolist()}"]
            command += [f"--offset={offset.tolist()}"]
            _await_plant(plant, stack.enter_context(started(command, {})))
            environment[ENVIRONMENT_VARIABLE] = str(plant)
        if isinstance(own.force_sensor, Jr3Settings):
            sensor = own.force_sensor
            command = ["tests.fakes.jr3_node", "--interface", sensor.interface]
            command += ["--channel", sensor.channel, "--node", str(sensor.node)]
            node = stack.enter_context(started(command, environment))
            assert node.stdout is not None
            if node.stdout.readline().strip() != "ready":
                raise RuntimeError("the JR3 node did not start")
        yield environment


def device_coordinates(settings: DeviceSettings) -> tuple[FloatArray, FloatArray]:
    """Return A and b of q = A d + b, as a device's settings have them."""
    match settings:
        case PhantomSettings():
            return PARALLELOGRAM, np.array(settings.joint_offset_rad) - [0.0, np.pi / 2.0]
        case QuanserSettings():  # it zeroes its encoders in the reference pose
            return np.array(settings.drive_matrix), np.zeros(len(settings.drive_matrix))
        case SerialPairSettings():
            near, b_near = device_coordinates(settings.proximal)
            far, b_far = device_coordinates(settings.distal)
            A = np.zeros((len(b_near) + len(b_far),) * 2)
            A[: len(b_near), : len(b_near)] = near
            A[len(b_near) :, len(b_near) :] = far
            return A, np.concatenate((b_near, b_far))
    raise ValueError(f"there is no fake for driver {settings.driver!r}")


def _vendor_libraries(settings: DeviceSettings, folder: Path) -> dict[str, str]:
    """Put fakes where a vendor's installer puts the real ones, and lead programs there."""
    parts: tuple[DeviceSettings, ...] = (settings,)
    if isinstance(settings, SerialPairSettings):
        parts = (settings.proximal, settings.distal)
    environment: dict[str, str] = {}
    if any(isinstance(part, PhantomSettings) for part in parts):
        (folder / "lib").mkdir()
        (folder / "lib" / "libHD.so").symlink_to(fake_hd.library())
        environment["LD_LIBRARY_PATH"] = _before("LD_LIBRARY_PATH", folder / "lib")
    if any(isinstance(part, QuanserSettings) for part in parts):
        package = folder / "python" / "quanser"
        package.mkdir(parents=True)
        (package / "__init__.py").touch()
        source = ROOT / "tests" / "fakes" / "quanser_hardware.py"
        (package / "hardware.py").symlink_to(source)
        environment["PYTHONPATH"] = _before("PYTHONPATH", folder / "python")
    return environment


def _before(variable: str, folder: Path) -> str:
    return os.pathsep.join(filter(None, (str(folder), os.environ.get(variable))))


def _await_plant(path: Path, process: "subprocess.Popen[str]") -> None:
    end_s = time.monotonic() + START_S
    while True:
        if path.exists():
            memory = PlantMemory(path)
            running = memory.running
            memory.close()
            if running:
                return
        if process.poll() is not None or time.monotonic() > end_s:
            raise RuntimeError("the plant did not start")
        time.sleep(0.01)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command among the fakes of a site; return its exit code."""
    parser = argparse.ArgumentParser(prog="python -m tests.fakes.bench", description=__doc__)
    parser.add_argument("session", type=Path)
    parser.add_argument("--site", choices=[site.label for site in SiteId], required=True)
    parser.add_argument("--plant", type=Path, help="session of the same robot, simulated")
    parser.add_argument("command", nargs="+")
    given = parser.parse_args(arguments)
    session = load_session(given.session)
    with fakes(session, SiteId[given.site.upper()], given.plant) as environment:
        return subprocess.run(given.command, env=os.environ | environment, check=False).returncode


if __name__ == "__main__":
    sys.exit(main())
