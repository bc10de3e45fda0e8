"""The machine's description, from a root of our own and from this one."""

import platform
from pathlib import Path

import pytest

from experiments.benchmarks.machine import describe_machine


@pytest.mark.parametrize(
    ("cpuinfo", "processor"),
    [
        ("model name\t: Fast One\nflags\t\t: fpu hypervisor sse\n", "Fast One, a virtual machine"),
        ("model name\t: Fast One\nflags\t\t: fpu sse\n", "Fast One"),
        ("Features\t: fp asimd\n", platform.machine()),
    ],
)
def test_the_processor_is_named(tmp_path: Path, cpuinfo: str, processor: str) -> None:
    (tmp_path / "proc").mkdir()
    (tmp_path / "proc" / "cpuinfo").write_text(cpuinfo, encoding="utf-8")
    assert describe_machine(tmp_path)["processor"] == processor


def test_this_machine_its_kernel_privileges_and_libraries_are_told() -> None:
    told = describe_machine()
    assert all(told.values())
    assert {"kernel", "cores", "governor", "clock", "privileges"} <= set(told)
    assert "preemption" in told["kernel"]
    assert told["Python"].endswith(platform.python_version())
    assert "numpy" in told["libraries"]
