"""What a figure was measured on."""

import os
import platform
import re
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from site_runtime.doctor_machine import ROOT, clock, cores, governor, kernel, privileges
from site_runtime.real_time import RealTimeSettings

_LIBRARIES = ("farhand", "numpy", "pin", "eclipse-zenoh", "mujoco")


def describe_machine(root: Path = ROOT) -> dict[str, str]:
    """Return what to know of the machine below `root`, and of this process's privileges."""
    found = (
        kernel(root),
        cores(None, "", root),
        governor(root),
        clock(root),
        privileges(RealTimeSettings("try"), root),
    )
    return {
        "processor": _processor((root / "proc/cpuinfo").read_text(encoding="utf-8")),
        **{finding.what: finding.measured for finding in found},
        "load average before": " ".join(f"{load:.2f}" for load in os.getloadavg()),
        "Python": f"{platform.python_implementation()} {platform.python_version()}",
        "libraries": ", ".join(f"{name} {_version(name)}" for name in _LIBRARIES),
    }


def _processor(cpuinfo: str) -> str:
    found = re.search(r"^model name\s*: (.*)$", cpuinfo, re.MULTILINE)
    name = found.group(1) if found else platform.machine()
    virtual = re.search(r"^flags\s*:.* hypervisor\b", cpuinfo, re.MULTILINE) is not None
    return f"{name}, a virtual machine" if virtual else name


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "absent"
