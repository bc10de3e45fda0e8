"""What a figure was measured on."""

import gzip
import os
import platform
import re
import resource
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

_ROOT = Path("/")
_LIBRARIES = ("farhand", "numpy", "pin", "eclipse-zenoh", "mujoco")
# linux/capability.h
_CAPABILITIES = {"CAP_SYS_NICE": 23, "CAP_IPC_LOCK": 14}
_LIMITS = {"rtprio": resource.RLIMIT_RTPRIO, "memlock": resource.RLIMIT_MEMLOCK}
_PREEMPTION = ("RT", "FULL", "LAZY", "VOLUNTARY", "NONE")


@dataclass(frozen=True, slots=True)
class ProcessorTimes:
    """What all processors did since the machine started [s], and what the host took from them."""

    total_s: float
    stolen_s: float

    def stolen_since(self, before: "ProcessorTimes") -> float:
        """Return the stolen share of the time since then."""
        total_s = self.total_s - before.total_s
        return (self.stolen_s - before.stolen_s) / total_s if total_s > 0.0 else 0.0


def processor_times(root: Path = _ROOT) -> ProcessorTimes:
    """Read them; see proc_stat(5)."""
    fields = _read(root / "proc/stat").splitlines()[0].split()[1:9]
    ticks = [int(field) / os.sysconf("SC_CLK_TCK") for field in fields]
    return ProcessorTimes(sum(ticks), ticks[7])


def describe_machine(root: Path = _ROOT) -> dict[str, str]:
    """Return what to know of this machine, its kernel and this process's privileges."""
    kernel = _kernel_configuration(root, platform.release())
    return {
        "processor": _processor(_read(root / "proc/cpuinfo")),
        "cores": f"{len(os.sched_getaffinity(0))} of {os.cpu_count()}",
        "kernel": f"{platform.system()} {platform.release()} {platform.version()}",
        "timer": f"{kernel['HZ']} Hz" if "HZ" in kernel else "unknown",
        "preemption": _preemption(root, kernel),
        "governor": _read(root / "sys/devices/system/cpu/cpu0/cpufreq/scaling_governor").strip()
        or "none told",
        "Python": f"{platform.python_implementation()} {platform.python_version()}",
        "libraries": ", ".join(f"{name} {_version(name)}" for name in _LIBRARIES),
        "privileges": _privileges(root),
    }


def load_average() -> str:
    """Return the load of the last 1, 5 and 15 minutes."""
    return " ".join(f"{load:.2f}" for load in os.getloadavg())


def _processor(cpuinfo: str) -> str:
    found = re.search(r"^model name\s*: (.*)$", cpuinfo, re.MULTILINE)
    name = found.group(1) if found else platform.machine()
    virtual = re.search(r"^flags\s*:.* hypervisor\b", cpuinfo, re.MULTILINE) is not None
    return f"{name}, a virtual machine" if virtual else name


def _kernel_configuration(root: Path, release: str) -> Mapping[str, str]:
    packed = root / "proc/config.gz"
    text = (
        gzip.decompress(packed.read_bytes()).decode()
        if packed.is_file()
        else _read(root / f"boot/config-{release}")
    )
    return dict(re.findall(r"^CONFIG_(\w+)=(.*)$", text, re.MULTILINE))


def _preemption(root: Path, kernel: Mapping[str, str]) -> str:
    chosen = re.search(r"\((\w+)\)", _read(root / "sys/kernel/debug/sched/preempt"))
    if chosen:
        return chosen.group(1)
    built = [f"PREEMPT_{kind}" for kind in _PREEMPTION if kernel.get(f"PREEMPT_{kind}") == "y"]
    if kernel.get("PREEMPT") == "y":
        built.append("PREEMPT")
    if kernel.get("PREEMPT_DYNAMIC") == "y":
        built.append("PREEMPT_DYNAMIC")
    return ", ".join(built) or "unknown"


def _privileges(root: Path) -> str:
    capable = re.search(r"^CapEff:\s*(\w+)$", _read(root / "proc/self/status"), re.MULTILINE)
    bits = int(capable.group(1), 16) if capable else 0
    held = [name for name, bit in _CAPABILITIES.items() if bits >> bit & 1]
    limits = ", ".join(f"{name} {_limit(number)}" for name, number in _LIMITS.items())
    return f"user {os.geteuid()}, {' and '.join(held) or 'no capabilities'}, limits {limits}"


def _limit(number: int) -> str:
    soft, _ = resource.getrlimit(number)
    return "unlimited" if soft == resource.RLIM_INFINITY else str(soft)


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "absent"


def _read(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except OSError:
        return ""
