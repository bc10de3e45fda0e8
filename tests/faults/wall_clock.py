"""A wall clock that jumps in one process alone, by a small library that is preloaded there."""

import mmap
import shutil
import struct
import subprocess
from pathlib import Path

SOURCE = Path(__file__).with_name("wall_clock.c")
COMPILER = shutil.which("cc")


def build(folder: Path) -> Path:
    """Compile the library into `folder` and return it; CalledProcessError if it does not."""
    library = folder / "wall_clock.so"
    if not library.exists():
        assert COMPILER is not None
        command = [COMPILER, "-O1", "-Wall", "-shared", "-fPIC", str(SOURCE)]
        subprocess.run([*command, "-o", str(library), "-ldl"], check=True)
    return library


class WallClock:
    """CLOCK_REALTIME of the process that is started with `environment`."""

    def __init__(self, folder: Path, name: str) -> None:
        path = folder / f"{name}.clock"
        path.write_bytes(bytes(16))
        self.library = build(folder)
        self.environment = {"LD_PRELOAD": str(self.library), "FARHAND_WALL_CLOCK": str(path)}
        with path.open("r+b") as file:
            self._memory = mmap.mmap(file.fileno(), 16)

    def set(self, offset_s: float) -> None:
        """Be ahead of the true time by this much from now on."""
        struct.pack_into("<q", self._memory, 0, round(offset_s * 1e9))

    @property
    def asked(self) -> int:
        """How often the process asked for the wall clock."""
        return int(struct.unpack_from("<q", self._memory, 8)[0])

    def close(self) -> None:
        """Let go of the clock; the process keeps it."""
        self._memory.close()
