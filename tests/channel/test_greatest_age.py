import pytest
from hypothesis import given
from hypothesis import strategies as st

from channel.greatest_age import WINDOW_NS, GreatestAge
from channel.packet import NO_AGE

HALF_NS = WINDOW_NS // 2
MS = 1_000_000
STEPS = (
    st.integers(1, 20 * MS)
    | st.integers(1, 3 * WINDOW_NS)
    | st.sampled_from([HALF_NS - 1, HALF_NS, HALF_NS + 1, WINDOW_NS - 1, WINDOW_NS, WINDOW_NS + 1])
)
AGES = st.integers(-(10**18), 10**18) | st.integers(-5, 5)


def test_before_the_first_age_there_is_none() -> None:
    assert GreatestAge().value_ns == NO_AGE


@given(start_ns=st.integers(-(10**15), 10**15), seen=st.lists(st.tuples(STEPS, AGES), min_size=1))
def test_it_is_the_maximum_of_the_last_half_to_full_window(
    start_ns: int, seen: list[tuple[int, int]]
) -> None:
    greatest, now_ns = GreatestAge(), start_ns
    ages: list[tuple[int, int]] = []
    for step_ns, age_ns in seen:
        now_ns += step_ns
        greatest.add(now_ns, age_ns)
        ages.append((now_ns, age_ns))
        at_least = max(age for at_ns, age in ages if now_ns - at_ns < HALF_NS)
        at_most = max(age for at_ns, age in ages if now_ns - at_ns < WINDOW_NS)
        assert at_least <= greatest.value_ns <= at_most


@pytest.mark.parametrize("period_ns", [MS, 7 * MS, 300 * MS])
def test_a_spike_is_remembered_for_half_a_window_and_forgotten_after_one(period_ns: int) -> None:
    for spike_ns in range(0, 2 * WINDOW_NS, 97 * MS):
        greatest, told = GreatestAge(), False
        for now_ns in range(0, 5 * WINDOW_NS, period_ns):
            spiked = not told and now_ns >= spike_ns
            if spiked:
                told, spike_at_ns = True, now_ns
            greatest.add(now_ns, 100 if spiked else 1)
            if told and now_ns - spike_at_ns < HALF_NS:
                assert greatest.value_ns == 100
            if not told or now_ns - spike_at_ns >= WINDOW_NS:
                assert greatest.value_ns == 1


def test_a_reset_forgets_everything() -> None:
    greatest = GreatestAge()
    greatest.add(0, 10**18)
    greatest.add(HALF_NS, 10**17)
    greatest.reset()
    assert greatest.value_ns == NO_AGE
    greatest.add(HALF_NS + 1, -7)
    assert greatest.value_ns == -7
