import ctypes
import gc
import os
import resource
import sys
import threading

import pytest

from site_runtime import real_time
from site_runtime.real_time import RealTimeError, RealTimeSettings, apply_real_time

PR_GET_TIMERSLACK = 30


def snapshot():
    """Everything that real-time settings may change, of this thread and process."""
    return {
        "scheduler": os.sched_getscheduler(0),
        "priority": os.sched_getparam(0).sched_priority,
        "affinity": os.sched_getaffinity(0),
        "collector": gc.isenabled(),
        "switch": sys.getswitchinterval(),
        "slack": ctypes.CDLL(None).prctl(PR_GET_TIMERSLACK, 0, 0, 0, 0),
        "frozen": gc.get_freeze_count() > 0,
    }


@pytest.fixture(autouse=True)
def _nothing_stays_changed():
    before = snapshot()
    yield
    assert snapshot() == before


@pytest.fixture
def granting(monkeypatch):
    """A system that grants everything, and notes what it was asked."""
    calls = []
    monkeypatch.setattr(real_time, "_libc_call", lambda *call: calls.append(call) or 50_000)
    monkeypatch.setattr(real_time, "_may_lock_without_limit", lambda: True)
    monkeypatch.setattr(
        os, "sched_setscheduler", lambda *call: calls.append(("scheduler", *call[:2]))
    )
    monkeypatch.setattr(os, "sched_setaffinity", lambda *call: calls.append(("cpu", *call)))
    return calls


@pytest.fixture
def refusing(monkeypatch):
    """A system that refuses the scheduler, the CPU and locked memory."""

    def refuse(*_):
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    monkeypatch.setattr(os, "sched_setaffinity", refuse)
    monkeypatch.setattr(real_time, "_may_lock_without_limit", lambda: False)
    monkeypatch.setattr(resource, "getrlimit", lambda _: (65536, 65536))


def test_off_leaves_the_process_as_it_is(granting):
    before = snapshot()
    with apply_real_time(RealTimeSettings(mode="off"), 0) as report:
        assert snapshot() == before
    assert (report.granted, report.refused, granting) == ((), (), [])


@pytest.mark.parametrize("mode", ["try", "enforce"])
def test_all_is_asked_for_and_given_back_in_reverse(granting, mode):
    with apply_real_time(RealTimeSettings(mode=mode, priority=70), 1) as report:
        assert report.refused == ()
        assert {"CPU 1", "memory locked", "SCHED_FIFO priority 70"} <= set(report.granted)
        assert not gc.isenabled()
        assert gc.get_freeze_count() > 0
        assert ("cpu", 0, {1}) in granting
        assert ("mlockall", 3) in granting
        assert granting[-1] == ("scheduler", 0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK)
        asked = len(granting)
    undone = [call[0] for call in granting[asked:]]
    assert undone == ["scheduler", "munlockall", "cpu", "prctl"]
    assert granting[asked] == ("scheduler", 0, os.SCHED_OTHER)
    report.release()
    assert len(granting) == asked + 4


def test_no_cpu_is_any_cpu(granting):
    with apply_real_time(RealTimeSettings()) as report:
        assert not any(granted.startswith("CPU") for granted in report.granted)


def test_try_runs_with_what_it_gets_and_says_what_it_did_not(refusing):
    with apply_real_time(RealTimeSettings(mode="try"), 0) as report:
        assert "garbage collector off" in report.granted
        assert not gc.isenabled()
        refused = {refusal.asked: str(refusal) for refusal in report.refused}
    assert set(refused) == {"CPU 0", "memory locked", "SCHED_FIFO priority 80"}
    assert "Operation not permitted" in refused["SCHED_FIFO priority 80"]
    assert "rtprio 80" in refused["SCHED_FIFO priority 80"]
    assert "65536 bytes" in refused["memory locked"]
    assert "memlock unlimited" in refused["memory locked"]


def test_enforce_refuses_to_run_and_leaves_nothing_changed(refusing):
    before = snapshot()
    with pytest.raises(RealTimeError) as caught:
        apply_real_time(RealTimeSettings(mode="enforce"), 0)
    assert snapshot() == before
    for words in ("enforce", "SCHED_FIFO", "rtprio 80", "memlock unlimited", "CPU 0"):
        assert words in str(caught.value)


def test_memory_is_not_locked_under_a_limit_that_a_later_allocation_could_meet(
    granting, monkeypatch
):
    monkeypatch.setattr(real_time, "_may_lock_without_limit", lambda: False)
    monkeypatch.setattr(resource, "getrlimit", lambda _: (2**40, 2**40))
    with apply_real_time(RealTimeSettings()) as report:
        assert [refusal.asked for refusal in report.refused] == ["memory locked"]
    assert not any(call[0] == "mlockall" for call in granting)
    monkeypatch.setattr(
        resource, "getrlimit", lambda _: (resource.RLIM_INFINITY, resource.RLIM_INFINITY)
    )
    with apply_real_time(RealTimeSettings()) as report:
        assert report.refused == ()


def test_a_collector_that_was_off_stays_off(granting):
    gc.disable()
    try:
        apply_real_time(RealTimeSettings()).release()
        assert not gc.isenabled()
    finally:
        gc.enable()


def test_it_is_released_when_the_loop_fails(granting):
    with pytest.raises(ZeroDivisionError), apply_real_time(RealTimeSettings()):
        raise ZeroDivisionError
    assert gc.isenabled()


def test_this_machine_grants_or_refuses_but_nothing_else():
    cpu = min(os.sched_getaffinity(0))
    seen = {}

    def helper():
        seen["scheduler"] = os.sched_getscheduler(0)

    with apply_real_time(RealTimeSettings(mode="try", priority=1), cpu) as report:
        assert len(report.granted) + len(report.refused) == 6
        assert os.sched_getaffinity(0) == {cpu}
        thread = threading.Thread(target=helper)
        thread.start()
        thread.join()
        real_time_granted = any(item.startswith("SCHED_FIFO") for item in report.granted)
        assert (os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == os.SCHED_FIFO) == (
            real_time_granted
        )
    assert seen["scheduler"] == os.SCHED_OTHER


def test_a_cpu_that_is_not_there_is_refused_by_name():
    with apply_real_time(RealTimeSettings(mode="try", priority=1), 4095) as report:
        refusal = next(item for item in report.refused if item.asked == "CPU 4095")
    assert "choose one of the CPUs" in str(refusal)
