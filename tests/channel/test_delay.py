import dataclasses
import math
from pathlib import Path
from typing import Annotated

import numpy as np
import pydantic
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from channel.delay import (
    BurstLoss,
    ConstantDelay,
    DelayModel,
    Direction,
    Duplication,
    Reordering,
    SinusoidDelay,
    TraceDelay,
    UniformDelay,
    _read_trace,
)
from channel.injection import Injection

NAN = math.nan
INF = math.inf


def rng() -> np.random.Generator:
    return np.random.default_rng(1)


@pytest.mark.parametrize(
    ("make", "key"),
    [
        (lambda: ConstantDelay(-0.1), "delay_s = -0.1"),
        (lambda: ConstantDelay(INF), "delay_s = inf"),
        (lambda: ConstantDelay(NAN), "delay_s = nan"),
        (lambda: ConstantDelay(1e300), r"delay_s = 1e\+300"),
        (lambda: SinusoidDelay(1e308, 1e308), r"mean_s = 1e\+308"),
        (lambda: Reordering(0.1, 1e300), r"extra_s = 1e\+300"),
        (lambda: ConstantDelay(0.1, model="sinusoid"), "model = 'sinusoid'"),  # type: ignore[arg-type]
        (lambda: SinusoidDelay(0.1, 0.2), "amplitude_s = 0.2"),
        (lambda: SinusoidDelay(0.1, -0.1), "amplitude_s = -0.1"),
        (lambda: SinusoidDelay(-0.1, 0.0), "mean_s = -0.1"),
        (lambda: SinusoidDelay(0.1, 0.1, NAN), "angular_frequency_rad_s = nan"),
        (lambda: SinusoidDelay(0.1, 0.1, 1.0, INF), "phase_rad = inf"),
        (lambda: UniformDelay(0.2, 0.1), "low_s = 0.2"),
        (lambda: UniformDelay(-0.2, 0.1), "low_s = -0.2"),
        (lambda: UniformDelay(0.0, INF), "high_s = inf"),
        (lambda: TraceDelay(""), "path = ''"),
        (lambda: BurstLoss(1.1, 0.5), "enter_burst = 1.1"),
        (lambda: BurstLoss(0.1, -0.5), "leave_burst = -0.5"),
        (lambda: BurstLoss(0.1, 0.5, NAN), "loss_in_burst = nan"),
        (lambda: BurstLoss(0.1, 0.5, 1.0, 2.0), "loss_outside = 2.0"),
        (lambda: Reordering(2.0, 0.1), "probability = 2.0"),
        (lambda: Reordering(0.1, -0.1), "extra_s = -0.1"),
        (lambda: Duplication(-1.0), "probability = -1.0"),
    ],
)
def test_bad_values_are_named(make: object, key: str) -> None:
    assert callable(make)
    with pytest.raises(ValueError, match=key):
        make()


def test_sinusoid_is_the_papers() -> None:
    delay = SinusoidDelay(0.1, 0.1)
    for time_s in np.linspace(-10.0, 10.0, 101):
        assert delay.at(time_s, rng()) == pytest.approx(0.1 + 0.1 * math.sin(time_s), abs=1e-15)
    assert delay.bound_s == 0.2
    quarter = SinusoidDelay(0.3, 0.1, angular_frequency_rad_s=2.0, phase_rad=math.pi / 2)
    assert quarter.at(0.0, rng()) == pytest.approx(0.4)
    assert quarter.at(math.pi / 2, rng()) == pytest.approx(0.2)


@settings(deadline=None)
@given(
    st.floats(0.0, 1e3),
    st.floats(0.0, 1.0),
    st.floats(-1e3, 1e3),
    st.floats(-1e3, 1e3),
    st.floats(-1e6, 1e6),
)
def test_sinusoid_stays_within_its_bound(
    mean_s: float, share: float, frequency: float, phase: float, time_s: float
) -> None:
    delay = SinusoidDelay(mean_s, mean_s * share, frequency, phase)
    assert 0.0 <= delay.at(time_s, rng()) <= delay.bound_s


def test_uniform_jumps_over_all_its_range() -> None:
    delay, generator = UniformDelay(0.1, 0.3), rng()
    draws = np.array([delay.at(0.0, generator) for _ in range(2000)])
    assert draws.min() >= 0.1
    assert draws.max() <= 0.3
    assert draws.min() < 0.102
    assert draws.max() > 0.298
    assert draws.mean() == pytest.approx(0.2, abs=0.005)
    assert abs(np.corrcoef(draws[:-1], draws[1:])[0, 1]) < 0.1


def test_trace_is_held_and_repeats(tmp_path: Path) -> None:
    (tmp_path / "trace.csv").write_text("time_s,delay_s\n5.0,0.1\n5.5,0.3\n6.0,0.2\n")
    direction = Direction(TraceDelay("trace.csv")).resolved(tmp_path)
    delay = direction.delay
    assert direction.bound_s == 0.3
    expected = {5.0: 0.1, 5.49: 0.1, 5.5: 0.3, 6.0: 0.2, 6.49: 0.2, 6.5: 0.1, 7.0: 0.3, 4.9: 0.2}
    for time_s, delay_s in expected.items():
        assert delay.at(time_s, rng()) == delay_s


def test_trace_of_one_row_is_a_constant(tmp_path: Path) -> None:
    file = tmp_path / "one.csv"
    file.write_text("time_s,delay_s\n0.0,0.25\n")
    assert {TraceDelay(str(file)).at(t, rng()) for t in (-3.7, 0.0, 1e6)} == {0.25}


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("", "holds no rows"),
        ("time_s,delay_s\n", "holds no rows"),
        ("time_s\n1.0\n", "row 1"),
        ("time_s,delay_s\n0.0,0.1\n1.0,fast\n", "row 2"),
        ("time_s,delay_s\n0.0,0.1\n0.0,0.1\n", "row 2: time_s = 0.0"),
        ("time_s,delay_s\n0.0,-0.1\n", "row 1: delay_s = -0.1"),
        ("time_s,delay_s\n0.0,nan\n", "row 1: delay_s = nan"),
    ],
)
def test_bad_traces_are_named(tmp_path: Path, text: str, complaint: str) -> None:
    file = tmp_path / "bad.csv"
    file.write_text(text)
    with pytest.raises(ValueError, match=complaint):
        _ = TraceDelay(str(file)).bound_s


def test_a_missing_trace_is_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"missing\.csv.*cannot be read"):
        _ = TraceDelay(str(tmp_path / "missing.csv")).bound_s


def test_a_trace_without_end_is_not_read() -> None:
    with pytest.raises(ValueError, match=r"/dev/zero.*no such file"):
        _ = TraceDelay("/dev/zero").bound_s


@settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    header=st.sampled_from([b"time_s,delay_s\n", b"delay_s,time_s\n", b"", b"time_s,time_s\n"]),
    rows=st.lists(
        st.lists(
            st.floats().map(lambda x: repr(x).encode())
            | st.integers(0, 100).map(lambda x: b"%d" % x)
            | st.binary(max_size=6)
            | st.sampled_from([b'"', b"1e999", b"\0", b"1_0", b" 3 ", b"0x1", b"\xff"]),
            max_size=3,
        ).map(b",".join),
        max_size=5,
    ),
)
def test_any_csv_is_a_delay_within_its_bound_or_a_value_error(
    tmp_path: Path, header: bytes, rows: list[bytes]
) -> None:
    file = tmp_path / "junk.csv"
    file.write_bytes(header + b"\n".join(rows))
    _read_trace.cache_clear()
    delay = TraceDelay(str(file))
    try:
        bound_s = delay.bound_s
    except ValueError as error:
        complaint = str(error)
    else:
        complaint = None
    if complaint is not None:
        assert "junk.csv" in complaint
        return
    assert math.isfinite(bound_s)
    for time_s in (-1e9, 0.0, 0.5, 1e9):
        assert 0.0 <= delay.at(time_s, rng()) <= bound_s
    Injection(Direction(delay), "exact", session_start_ns=0, seed=(1,))


def test_direction_bound_counts_what_is_held_back() -> None:
    assert Direction(SinusoidDelay(0.1, 0.1)).bound_s == 0.2
    assert Direction(ConstantDelay(0.1), reordering=Reordering(0.1, 0.05)).bound_s == (
        pytest.approx(0.15)
    )


@pytest.mark.parametrize(
    "delay",
    [ConstantDelay(0.2), SinusoidDelay(0.1, 0.1), UniformDelay(0.0, 0.2), TraceDelay("a.csv")],
)
def test_the_dataclasses_are_a_schema(delay: DelayModel) -> None:
    direction = Direction(delay, BurstLoss(0.1, 0.5), Reordering(0.1, 0.1), Duplication(0.1))
    schema = pydantic.TypeAdapter(Direction)
    assert schema.validate_python(dataclasses.asdict(direction)) == direction
    tagged: pydantic.TypeAdapter[DelayModel] = pydantic.TypeAdapter(
        Annotated[DelayModel, pydantic.Field(discriminator="model")]
    )
    assert tagged.validate_python(dataclasses.asdict(delay)) == delay
    with pytest.raises(pydantic.ValidationError, match=r"amplitude_s = 0\.3 is not allowed"):
        tagged.validate_python({"model": "sinusoid", "mean_s": 0.1, "amplitude_s": 0.3})
