"""What the doctor reads from /proc and /sys, of machines made of files."""

import gzip
import os
from pathlib import Path

import pytest

from site_runtime import doctor_machine
from site_runtime.doctor_findings import Finding, Verdict, holds_the_rate
from site_runtime.doctor_machine import ProcessorTimes
from site_runtime.real_time import RealTimeSettings

GOOD, WILL_DO, NOT_GOOD = Verdict.GOOD, Verdict.WILL_DO, Verdict.NOT_GOOD
RELEASE = "6.12.9"
NOTHING_HELD, SYS_NICE, IPC_LOCK = 0, 1 << 23, 1 << 14


def write(root: Path, files: dict[str, str]) -> Path:
    for name, text in files.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text + "\n", encoding="utf-8")
    return root


def linux(root: Path, options: str = "", **files: str) -> Path:
    return write(
        root,
        {"proc/sys/kernel/osrelease": RELEASE, f"boot/config-{RELEASE}": options}
        | {name.replace("__", "/"): text for name, text in files.items()},
    )


@pytest.mark.parametrize(
    ("options", "files", "preemption", "verdict"),
    [
        ("CONFIG_PREEMPT_RT=y", {}, "PREEMPT_RT", GOOD),
        ("", {"sys__kernel__realtime": "1"}, "PREEMPT_RT", GOOD),
        ("CONFIG_PREEMPT=y", {}, "full", GOOD),
        ("CONFIG_PREEMPT_LAZY=y\nCONFIG_PREEMPT_DYNAMIC=y", {}, "lazy", WILL_DO),
        ("CONFIG_PREEMPT_VOLUNTARY=y", {}, "voluntary", WILL_DO),
        ("CONFIG_PREEMPT_NONE=y", {}, "none", WILL_DO),
        ("# CONFIG_PREEMPT_NONE is not set", {}, "unknown", WILL_DO),
        (
            "",
            {"proc__version": "Linux 6.1 #1 SMP PREEMPT_DYNAMIC Debian"},
            "PREEMPT_DYNAMIC",
            WILL_DO,
        ),
        (
            "CONFIG_PREEMPT_VOLUNTARY=y\nCONFIG_PREEMPT_DYNAMIC=y",
            {"proc__cmdline": "quiet preempt=full"},
            "full",
            GOOD,
        ),
        (  # what the kernel says of itself now counts more
            "CONFIG_PREEMPT_VOLUNTARY=y\nCONFIG_PREEMPT_DYNAMIC=y",
            {
                "proc__cmdline": "preempt=full",
                "sys__kernel__debug__sched__preempt": "none (voluntary) full",
            },
            "voluntary",
            WILL_DO,
        ),
    ],
)
def test_kernel(
    tmp_path: Path, options: str, files: dict[str, str], preemption: str, verdict: Verdict
) -> None:
    found = doctor_machine.kernel(linux(tmp_path, options, **files))
    assert f"{RELEASE}, preemption {preemption}," in found.measured
    assert found.verdict is verdict
    assert ("PREEMPT_RT" in found.change) is (verdict is WILL_DO)
    assert not found.decisive


def test_kernel_options_may_be_packed(tmp_path: Path) -> None:
    root = write(tmp_path, {"proc/sys/kernel/osrelease": RELEASE})
    packed = gzip.compress(b"CONFIG_HZ=1000\nCONFIG_PREEMPT=y\nCONFIG_HIGH_RES_TIMERS=y\n")
    (root / "proc/config.gz").write_bytes(packed)
    told = doctor_machine.kernel(root).measured
    assert told == f"{RELEASE}, preemption full, high-resolution timers, HZ 1000"


def rights(root: Path, held: int, rtprio: str, memlock: str) -> Path:
    limits = (
        "Limit                     Soft Limit           Hard Limit           Units\n"
        f"Max locked memory         {memlock:<20} unlimited            bytes\n"
        f"Max realtime priority     {rtprio:<20} 99\n"
    )
    status = f"Name:\tpython\nCapPrm:\tffff\nCapEff:\t{held:016x}"
    return write(root, {"proc/self/limits": limits, "proc/self/status": status})


@pytest.mark.parametrize(
    ("held", "rtprio", "memlock", "lacks"),
    [
        (NOTHING_HELD, "0", "8388608", ("rtprio 80", "memlock")),
        (NOTHING_HELD, "79", "unlimited", ("rtprio 80",)),
        (NOTHING_HELD, "80", "8388608", ("memlock",)),
        (NOTHING_HELD, "80", "unlimited", ()),
        (SYS_NICE, "0", "8388608", ("memlock",)),
        (SYS_NICE | IPC_LOCK, "0", "8388608", ()),
    ],
)
@pytest.mark.parametrize("mode", ["enforce", "try", "off"])
def test_privileges(
    tmp_path: Path, held: int, rtprio: str, memlock: str, lacks: tuple[str, ...], mode: str
) -> None:
    root = rights(tmp_path, held, rtprio, memlock)
    found = doctor_machine.privileges(RealTimeSettings(mode), root)  # type: ignore[arg-type]
    if mode == "off" or not lacks:
        assert (found.verdict, found.change) == (GOOD, "")
        return
    assert found.verdict is (NOT_GOOD if mode == "enforce" else WILL_DO)
    assert holds_the_rate([found]) is (mode == "try")  # enforced, a site would not start
    asked, _, elsewhere = found.change.partition("into /etc/security/limits.d")
    for line in ("rtprio 80", "memlock"):
        assert (f'"USER - {line}' in asked) is (line in lacks)
    assert "LimitRTPRIO=80" in elsewhere


@pytest.mark.parametrize(
    ("governors", "idle_us", "disabled", "changes"),
    [
        ((), (), "0", ()),
        (("performance", "performance"), (1, 50), "0", ()),
        (("performance", "powersave"), (), "0", ("frequency-set",)),
        (("schedutil",), (1, 400), "0", ("frequency-set", "idle-set")),
        (("performance",), (1, 400), "1", ()),
    ],
)
def test_governor(
    tmp_path: Path,
    governors: tuple[str, ...],
    idle_us: tuple[int, ...],
    disabled: str,
    changes: tuple[str, ...],
) -> None:
    cpu = "sys/devices/system/cpu/cpu"
    files = {f"{cpu}{i}/cpufreq/scaling_governor": name for i, name in enumerate(governors)}
    for state, latency_us in enumerate(idle_us):
        files[f"{cpu}0/cpuidle/state{state}/latency"] = str(latency_us)
        files[f"{cpu}0/cpuidle/state{state}/disable"] = disabled
    found = doctor_machine.governor(write(tmp_path, files))
    assert found.verdict is (WILL_DO if changes else GOOD)
    for command in ("frequency-set", "idle-set"):
        assert (command in found.change) is (command in changes)
    assert all(name in found.measured for name in governors)


@pytest.mark.parametrize(
    ("allowed", "isolated", "chosen", "verdict", "change"),
    [
        ({0}, "", None, WILL_DO, "a second core"),
        ({0, 1}, "", None, GOOD, "isolcpus=1 nohz_full=1, and local_cpu = 1"),
        (set(range(8)), "3,5-6", None, WILL_DO, "local_cpu = 3"),
        (set(range(8)), "3,5-6", 2, WILL_DO, "local_cpu = 3"),
        (set(range(8)), "3,5-6", 6, GOOD, ""),
    ],
)
def test_cores(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    allowed: set[int],
    isolated: str,
    chosen: int | None,
    verdict: Verdict,
    change: str,
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: allowed)
    root = write(tmp_path, {"sys/devices/system/cpu/isolated": isolated})
    found = doctor_machine.cores(chosen, "local_cpu", root)
    assert found.verdict is verdict
    assert change in found.change
    assert (found.change == "") is (change == "")


@pytest.mark.parametrize(
    ("now", "verdict", "changes"),
    [
        ("cpu  110 0 110 1780 0 0 0 0 0 0", GOOD, ()),
        ("cpu  110 0 110 1700 0 0 0 80 0 0", WILL_DO, ("the host",)),
        ("cpu  1000 0 100 800 100 0 0 0 0 0", WILL_DO, ("top",)),
        ("cpu  400 0 100 800 700 0 0 0 0 0", GOOD, ()),  # waiting for a disk is idle
        ("cpu  100 0 100 800 0 0 0 0 0 0", GOOD, ()),  # too short to count
    ],
)
def test_load(tmp_path: Path, now: str, verdict: Verdict, changes: tuple[str, ...]) -> None:
    before = ProcessorTimes(total=1000, idle=800, stolen=0)
    root = write(
        tmp_path, {"proc/stat": f"{now}\ncpu0 1 2 3", "proc/loadavg": "0.10 0.2 0.3 1/2 3"}
    )
    found = doctor_machine.load(before, root)
    assert found.verdict is verdict
    assert "load average 0.10" in found.measured
    for word in ("the host", "top"):
        assert (word in found.change) is (word in changes)


@pytest.mark.parametrize(
    ("source", "verdict"), [("tsc", GOOD), ("kvm-clock", GOOD), ("hpet", WILL_DO), ("", WILL_DO)]
)
def test_clock(tmp_path: Path, source: str, verdict: Verdict) -> None:
    name = "sys/devices/system/clocksource/clocksource0/current_clocksource"
    found = doctor_machine.clock(write(tmp_path, {name: source} if source else {}))
    assert found.verdict is verdict
    assert ("clocksource=tsc" in found.change) is (source == "hpet")


def test_a_machine_that_tells_nothing_is_looked_at_all_the_same(tmp_path: Path) -> None:
    for found in (
        doctor_machine.kernel(tmp_path),
        doctor_machine.privileges(RealTimeSettings(), tmp_path),
        doctor_machine.governor(tmp_path),
        doctor_machine.cores(None, "local_cpu", tmp_path),
        doctor_machine.clock(tmp_path),
    ):
        assert found.verdict in (GOOD, WILL_DO)


def test_this_machine_is_read() -> None:
    before = doctor_machine.processor_times()
    assert before.total > before.idle >= 0
    assert doctor_machine.load(before).measured
    assert doctor_machine.kernel().measured.startswith(os.uname().release)


def test_only_what_is_decisive_decides() -> None:
    why = Finding("why", NOT_GOOD, "told")
    loop = Finding("loop", NOT_GOOD, "told", decisive=True)
    assert holds_the_rate([why, Finding("loop", WILL_DO, "told", decisive=True)])
    assert not holds_the_rate([why, loop])
    assert not holds_the_rate([Finding("loop", Verdict.NOT_MEASURED, "told", decisive=True)])
