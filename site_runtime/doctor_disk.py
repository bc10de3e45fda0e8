"""Whether the flight recorder's disk takes what a site writes."""

import os
import shutil
import tempfile
import time
from pathlib import Path
from statistics import median

from site_runtime.doctor_findings import Finding, Verdict

_BLOCK = 64 * 1024
_WRITES = 30
_SLOW_S, _TOO_SLOW_S = 0.5, 5.0  # the rows' ring holds 12 s
_ROOMY_BYTES, _FULL_BYTES = 10 * 2**30, 2**30


def disk_writes(folder: Path) -> Finding:
    """Write and synchronise blocks in the recordings' folder, or the nearest that exists."""
    place = _existing(folder)
    try:
        took_s = _synchronised_writes(place)
    except OSError as error:
        change = f"let this user write there, or set directory under [recorder] ({error.strerror})"
        return Finding("disk writes", Verdict.NOT_GOOD, f"{place} cannot be written to", change)
    worst_s = max(took_s)
    p50_ms, worst_ms = median(took_s) * 1e3, worst_s * 1e3
    told = f"{place}: 64 KiB synchronised in {p50_ms:.1f} ms, worst {worst_ms:.1f} ms"
    if worst_s <= _SLOW_S:
        return Finding("disk writes", Verdict.GOOD, told)
    change = "record on another disk: directory under [recorder] in the session file"
    verdict = Verdict.WILL_DO if worst_s <= _TOO_SLOW_S else Verdict.NOT_GOOD
    return Finding("disk writes", verdict, told, change)


def free_disk(folder: Path, keep_s: float) -> Finding:
    """Room where recordings go; `keep_s` is how much of the past is kept."""
    place = _existing(folder)
    free = shutil.disk_usage(place).free
    told = f"{free / 2**30:.1f} GiB free at {place}, for the last {keep_s / 3600:g} h and incidents"
    if free >= _ROOMY_BYTES:
        return Finding("free disk", Verdict.GOOD, told)
    change = "make room, or keep_s and directory under [recorder] in the session file"
    verdict = Verdict.WILL_DO if free >= _FULL_BYTES else Verdict.NOT_GOOD
    return Finding("free disk", verdict, told, change)


def _existing(folder: Path) -> Path:
    return next(place for place in (folder, *folder.absolute().parents) if place.is_dir())


def _synchronised_writes(place: Path) -> list[float]:
    block = os.urandom(_BLOCK)
    took_s = []
    with tempfile.TemporaryFile(dir=place) as file:
        for _ in range(_WRITES):
            start_s = time.perf_counter()
            file.write(block)
            file.flush()
            os.fsync(file.fileno())
            took_s.append(time.perf_counter() - start_s)
    return took_s
