"""What /proc and /sys tell of a machine that is to run a loop; `root` is where they are."""

import gzip
import os
import re
from dataclasses import dataclass
from pathlib import Path

from site_runtime.doctor_findings import Finding, Verdict
from site_runtime.real_time import RealTimeSettings

ROOT = Path("/")
LIMITS_FILE = "/etc/security/limits.d/99-farhand.conf"
_CAP_IPC_LOCK, _CAP_SYS_NICE = 14, 23  # linux/capability.h
_QUICK_CLOCKS = ("tsc", "kvm-clock", "hyperv_clocksource_tsc_page", "arch_sys_counter")
_DEEP_SLEEP_US = 50
_STOLEN_SHARE = 0.01


def kernel(root: Path = ROOT) -> Finding:
    """Its version, what may interrupt it, and its timer."""
    release = _read(root, "proc/sys/kernel/osrelease") or "unknown"
    options = _kernel_options(root, release)
    preemption = _preemption(root, options)
    hz = options.get("HZ", "unknown")
    timer = "high-resolution timers" if options.get("HIGH_RES_TIMERS") == "y" else "timer"
    verdict = {"PREEMPT_RT": Verdict.GOOD, "full": Verdict.GOOD}.get(preemption, Verdict.WILL_DO)
    change = ""
    if verdict is not Verdict.GOOD:
        change = (
            "if wake-ups are late: a PREEMPT_RT kernel (Debian: apt install linux-image-rt-amd64; "
            "Ubuntu: pro enable realtime-kernel), or the kernel parameter preempt=full"
        )
    return Finding(
        "kernel", verdict, f"{release}, preemption {preemption}, {timer}, HZ {hz}", change
    )


def privileges(settings: RealTimeSettings, root: Path = ROOT) -> Finding:
    """Whether this user may have what the session asks for."""
    held = int(_field(root, "proc/self/status", "CapEff") or "0", 16)
    rtprio = _soft_limit(root, "Max realtime priority")
    memlock = _soft_limit(root, "Max locked memory")
    may_schedule = held >> _CAP_SYS_NICE & 1 or rtprio >= settings.priority
    may_lock = held >> _CAP_IPC_LOCK & 1 or memlock == float("inf")
    measured = f"rtprio {_limit(rtprio)}, memlock {_limit(memlock)}, CAP_SYS_NICE " + (
        "held" if held >> _CAP_SYS_NICE & 1 else "not held"
    )
    if settings.mode == "off" or (may_schedule and may_lock):
        return Finding("privileges", Verdict.GOOD, measured)
    lines = []
    if not may_schedule:
        lines.append(f'"USER - rtprio {settings.priority}"')
    if not may_lock:
        lines.append('"USER - memlock unlimited"')
    change = (
        f"put {' and '.join(lines)} into {LIMITS_FILE} and log in again; under systemd: "
        f"LimitRTPRIO={settings.priority}, LimitMEMLOCK=infinity; in a container: "
        f"--ulimit rtprio={settings.priority} --ulimit memlock=-1 --cap-add SYS_NICE"
    )
    enforced = settings.mode == "enforce"  # then a site refuses to start
    verdict = Verdict.NOT_GOOD if enforced else Verdict.WILL_DO
    return Finding("privileges", verdict, measured, change, decisive=enforced)


def governor(root: Path = ROOT) -> Finding:
    """Whether the processor changes its speed, and how deep it sleeps between ticks."""
    cpus = root / "sys/devices/system/cpu"
    names = {
        path.read_text(encoding="ascii").strip()
        for path in cpus.glob("cpu[0-9]*/cpufreq/scaling_governor")
    }
    depths_us = [
        int(_read(path, "latency") or "0")
        for path in cpus.glob("cpu[0-9]*/cpuidle/state[0-9]*")
        if _read(path, "disable") != "1"
    ]
    deepest_us = max(depths_us, default=0)
    told = ", ".join(sorted(names)) or "none visible (a virtual machine, or the firmware's)"
    changes = []
    if names - {"performance"}:
        changes.append("cpupower frequency-set -g performance")
    if deepest_us > _DEEP_SLEEP_US:
        changes.append(f"if wake-ups are late: cpupower idle-set -D {_DEEP_SLEEP_US}")
    return Finding(
        "governor",
        Verdict.WILL_DO if changes else Verdict.GOOD,
        f"{told}; deepest idle state wakes in {deepest_us} µs",
        "; ".join(changes),
    )


def cores(chosen: int | None, key: str, root: Path = ROOT) -> Finding:
    """How many there are, which are kept free, and whether the session's choice is one of them.

    `key` is the session file's, `chosen` its value.
    """
    allowed = os.sched_getaffinity(0)
    isolated = _cpu_list(_read(root, "sys/devices/system/cpu/isolated"))
    measured = f"{len(allowed)} for this process, isolated: {_named(isolated) or 'none'}"
    if chosen is not None:
        measured += f", the session's: {chosen}"
    if len(allowed) < 2:
        return Finding(
            "cores",
            Verdict.WILL_DO,
            measured,
            "give it a second core: Zenoh, the recorder and the kernel want one beside the loop",
        )
    if isolated and chosen not in isolated:
        change = f"take an isolated one: {key} = {min(isolated)} under [real_time] in the session"
        return Finding("cores", Verdict.WILL_DO, measured, change)
    if not isolated:
        last = max(allowed)
        change = (
            f"if wake-ups are late: kernel parameters isolcpus={last} nohz_full={last}, and "
            f"{key} = {last} under [real_time] in the session file"
        )
        return Finding("cores", Verdict.GOOD, measured, change)
    return Finding("cores", Verdict.GOOD, measured)


@dataclass(frozen=True, slots=True)
class ProcessorTimes:
    """What all processors did since the start, and what the host took of it [kernel ticks]."""

    total: int
    idle: int
    stolen: int


def processor_times(root: Path = ROOT) -> ProcessorTimes:
    """Read them; see proc_stat(5)."""
    fields = [int(field) for field in _read(root, "proc/stat").splitlines()[0].split()[1:9]]
    return ProcessorTimes(sum(fields), fields[3] + fields[4], fields[7])


def load(before: ProcessorTimes, root: Path = ROOT) -> Finding:
    """How busy the processors were since `before`, and what the host took of them."""
    now = processor_times(root)
    passed = now.total - before.total
    stolen = (now.stolen - before.stolen) / max(passed, 1)
    busy = (passed - (now.idle - before.idle)) / max(passed, 1)
    average = _read(root, "proc/loadavg").split()[0]
    changes = []
    if stolen > _STOLEN_SHARE:
        changes.append("the host takes time from this machine: give it processors of its own")
    if busy > 0.5:
        changes.append("end what else runs here (top), or keep it off the loop's core (taskset)")
    return Finding(
        "load",
        Verdict.WILL_DO if changes else Verdict.GOOD,
        f"load average {average}, processors {busy:.0%} busy and {stolen:.1%} stolen by the host "
        "while measuring",
        "; ".join(changes),
    )


def clock(root: Path = ROOT) -> Finding:
    """Where monotonic time comes from.

    Sites measure each other's clocks on the link: no synchronisation is needed. A daemon that
    slews the wall clock (by 500 ppm at most) changes monotonic time as little.
    """
    source = _read(root, "sys/devices/system/clocksource/clocksource0/current_clocksource")
    measured = f"clock source {source or 'unknown'}; synchronised or not does not matter here"
    if source in _QUICK_CLOCKS:
        return Finding("clock", Verdict.GOOD, measured)
    change = "every reading takes long: kernel parameter clocksource=tsc tsc=reliable"
    return Finding("clock", Verdict.WILL_DO, measured, change if source else "")


def _preemption(root: Path, options: dict[str, str]) -> str:
    if _read(root, "sys/kernel/realtime") == "1" or options.get("PREEMPT_RT") == "y":
        return "PREEMPT_RT"
    chosen = re.search(r"\((\w+)\)", _read(root, "sys/kernel/debug/sched/preempt"))
    if chosen:
        return chosen.group(1)
    given = re.search(r"\bpreempt=(\w+)", _read(root, "proc/cmdline"))
    if given and options.get("PREEMPT_DYNAMIC") == "y":
        return given.group(1)
    built = [
        name
        for kind in ("", "_LAZY", "_VOLUNTARY", "_NONE")
        if options.get(name := f"PREEMPT{kind}") == "y"
    ]
    return {"PREEMPT": "full", "PREEMPT_LAZY": "lazy", "PREEMPT_VOLUNTARY": "voluntary"}.get(
        built[0] if built else "", "none" if built else _banner(root)
    )


def _banner(root: Path) -> str:
    """Without the kernel's options, its own words: `SMP PREEMPT_DYNAMIC Debian ...`."""
    found = re.search(r"\bPREEMPT\w*", _read(root, "proc/version"))
    return found.group(0) if found else "unknown"


def _kernel_options(root: Path, release: str) -> dict[str, str]:
    packed = root / "proc/config.gz"
    try:
        text = gzip.decompress(packed.read_bytes()).decode("utf-8")
    except OSError:
        text = _read(root, f"boot/config-{release}")
    return dict(re.findall(r"^CONFIG_(\w+)=(.*)$", text, re.MULTILINE))


def _soft_limit(root: Path, name: str) -> float:
    found = re.search(rf"^{name}\s+(\S+)", _read(root, "proc/self/limits"), re.MULTILINE)
    if found is None:
        return 0.0
    return float("inf") if found.group(1) == "unlimited" else float(found.group(1))


def _limit(value: float) -> str:
    return "unlimited" if value == float("inf") else f"{value:.0f}"


def _field(root: Path, file: str, name: str) -> str:
    found = re.search(rf"^{name}:\s*(\S+)", _read(root, file), re.MULTILINE)
    return found.group(1) if found else ""


def _cpu_list(text: str) -> set[int]:
    """Read the kernel's form, `1,4-7`."""
    listed: set[int] = set()
    for part in filter(None, text.split(",")):
        first, _, last = part.partition("-")
        listed |= set(range(int(first), int(last or first) + 1))
    return listed


def _named(numbers: set[int]) -> str:
    return ", ".join(map(str, sorted(numbers)))


def _read(root: Path, name: str) -> str:
    try:
        return (root / name).read_text(encoding="utf-8").strip()
    except OSError:
        return ""
