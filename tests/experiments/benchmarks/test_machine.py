"""The machine's description, from a root of our own and from this one."""

import gzip
import platform
from pathlib import Path

import pytest

from experiments.benchmarks.machine import describe_machine, processor_times


@pytest.fixture
def root(tmp_path: Path) -> Path:
    for name, text in {
        "proc/cpuinfo": "processor\t: 0\nmodel name\t: Fast One\nflags\t\t: fpu hypervisor sse\n",
        "proc/self/status": "Name:\tpython\nCapEff:\t0000000000800000\n",
        "proc/stat": "cpu  100 0 100 700 50 0 0 50 0 0\ncpu0 1 2 3\n",
        "sys/devices/system/cpu/cpu0/cpufreq/scaling_governor": "performance\n",
    }.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text, encoding="utf-8")
    return tmp_path


def test_processor_governor_and_kernel_are_told(root: Path) -> None:
    options = (
        b"CONFIG_HZ_1000=y\nCONFIG_HZ=1000\nCONFIG_PREEMPT_RT=y\n# CONFIG_PREEMPT is not set\n"
    )
    (root / "proc" / "config.gz").write_bytes(gzip.compress(options))
    told = describe_machine(root)
    assert told["processor"] == "Fast One, a virtual machine"
    assert told["governor"] == "performance"
    assert told["timer"] == "1000 Hz"
    assert told["preemption"] == "PREEMPT_RT"
    assert f"Python {told['Python']}".endswith(platform.python_version())
    assert "numpy" in told["libraries"]
    assert "CAP_SYS_NICE, limits rtprio" in told["privileges"]


def test_the_configuration_may_lie_in_boot_and_the_choice_at_run_time_counts(root: Path) -> None:
    config = root / "boot" / f"config-{platform.release()}"
    config.parent.mkdir()
    config.write_text(
        "CONFIG_HZ=250\nCONFIG_PREEMPT_NONE=y\nCONFIG_PREEMPT_DYNAMIC=y\n", encoding="utf-8"
    )
    assert describe_machine(root)["preemption"] == "PREEMPT_NONE, PREEMPT_DYNAMIC"
    chosen = root / "sys" / "kernel" / "debug" / "sched" / "preempt"
    chosen.parent.mkdir(parents=True)
    chosen.write_text("none voluntary (full) lazy\n", encoding="utf-8")
    told = describe_machine(root)
    assert told["timer"] == "250 Hz"
    assert told["preemption"] == "full"


def test_what_a_machine_does_not_tell_is_unknown(tmp_path: Path) -> None:
    told = describe_machine(tmp_path)
    assert told["timer"] == told["preemption"] == "unknown"
    assert told["governor"] == "none told"


def test_stolen_time_is_a_share(root: Path) -> None:
    before = processor_times(root)
    (root / "proc" / "stat").write_text("cpu  150 0 100 700 50 0 0 100 0 0\n", encoding="utf-8")
    assert processor_times(root).stolen_since(before) == pytest.approx(0.5)
    assert before.stolen_since(before) == 0.0


def test_this_machine_has_a_description() -> None:
    assert all(describe_machine().values())
    assert processor_times().total_s > 0.0
