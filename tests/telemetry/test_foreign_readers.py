"""Recordings in the readers of others: every row and event by name, bit by bit."""

import re
import subprocess
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rerun.chunk import RrdReader

from telemetry.piece import Piece
from telemetry.recording import RecordingSource, RecordingWriter
from telemetry.row_ring import ARRIVAL, ARRIVAL_BYTES, SiteEvent
from telemetry.rows import COLUMNS, RowArray, row_dtype

EVENTS = (SiteEvent(1_000, "READY"), SiteEvent(-2_000, ""), SiteEvent(2_000, "FAULT: ∫ failed"))
SHAPES = [(2, 2), (3, 2), (7, 3)]


def some_rows(joints: int, dimension: int, count: int = 60) -> RowArray:
    """Rows of any bits, but for what orders them: NaN and infinities of all kinds among them."""
    dtype = row_dtype(joints, dimension)
    rows = np.frombuffer(np.random.default_rng(5).bytes(count * dtype.itemsize), dtype).copy()
    rows["q"][::3] = np.nan
    rows["sequence"] = np.arange(count)
    rows["stamp_ns"] = 1_000_000 * np.arange(count)
    return rows


def some_arrivals(count: int = 9) -> RowArray:
    arrivals = np.zeros(count, ARRIVAL)
    arrivals["number"] = np.arange(count)
    arrivals["row"] = 5 * np.arange(count)
    arrivals["length"] = ARRIVAL_BYTES - np.arange(count)
    arrivals["data"] = np.random.default_rng(6).integers(0, 256, (count, ARRIVAL_BYTES))
    return arrivals


def record(path: Path, rows: RowArray, arrivals: RowArray) -> Path:
    shape = (rows["q"].shape[1], rows["position_m"].shape[1])
    source = RecordingSource("remote", *shape, 10**18, "format = 1\n", {"epoch": "9"})
    writer = RecordingWriter(path, source)
    half = len(rows) // 2
    writer.write(Piece(rows[:half], EVENTS, arrivals[:4]))
    writer.write(Piece(rows[half:], (), arrivals[4:]))
    writer.close()
    return path


def assert_same_bits(value: Any, expected: Any, name: str) -> None:
    expected = np.asarray(expected)
    value = list(value) if isinstance(value, bytes) else value
    assert np.asarray(value, expected.dtype).tobytes() == expected.tobytes(), name


@pytest.mark.parametrize(("joints", "dimension"), SHAPES)
def test_the_decoder_of_ros_2_messages_reads_rows_events_and_arrivals(
    tmp_path: Path, joints: int, dimension: int
) -> None:
    rows, arrivals = some_rows(joints, dimension), some_arrivals()
    path = record(tmp_path / "a.mcap", rows, arrivals)
    read: dict[str, list[Any]] = {}
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, _, message in reader.iter_decoded_messages():
            read.setdefault(channel.topic, []).append(message)
    assert len(read["/remote/rows"]) == len(rows)
    for row, message in zip(rows, read["/remote/rows"], strict=True):
        for name in COLUMNS:
            assert_same_bits(getattr(message, name), row[name], name)
    # the reader sorts by time
    assert sorted((e.stamp_ns, e.text) for e in read["/remote/events"]) == sorted(EVENTS)
    came = [one for message in read["/remote/arrivals"] for one in message.arrivals]
    assert len(came) == len(arrivals)
    for one, arrival in zip(came, arrivals, strict=True):
        for name in ARRIVAL.names or ():
            assert_same_bits(getattr(one, name), arrival[name], name)


def test_the_page_s_lines_read_the_rows(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = some_rows(2, 2, 5)
    path = record(tmp_path / "rows.mcap", rows, some_arrivals())
    page = (Path(__file__).parents[2] / "docs" / "tools.md").read_text(encoding="utf-8")
    [code] = [c for c in re.findall(r"```python\n(.*?)```", page, re.DOTALL) if "mcap_ros2" in c]
    code = code.replace('"rows.mcap"', repr(str(path))).replace("/local/", "/remote/")
    exec(code, {})  # noqa: S102 - the page's own
    told = capsys.readouterr().out.splitlines()
    assert [int(line.split()[1]) for line in told] == rows["time_ns"].tolist()


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, RowArray]:
    rows = some_rows(3, 2)
    return record(tmp_path_factory.mktemp("foreign") / "a.mcap", rows, some_arrivals()), rows


def rerun(*arguments: str | Path) -> str:
    command = [str(files("rerun_cli") / "rerun"), "mcap", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    return done.stdout + done.stderr


def test_rerun_names_the_topics_and_their_messages(recorded: tuple[Path, RowArray]) -> None:
    told = rerun("info", recorded[0])
    for topic in ("/remote/rows", "/remote/events", "/remote/arrivals"):
        assert topic in told


def test_rerun_converts_rows_to_typed_fields(
    recorded: tuple[Path, RowArray], tmp_path: Path
) -> None:
    path, rows = recorded
    rerun("convert", path, "-o", tmp_path / "a.rrd")
    decoded, texts = {}, set()
    for chunk in RrdReader(tmp_path / "a.rrd").stream():
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            if name.endswith("Row:message"):
                decoded |= {row[0]["sequence"]: row[0] for row in batch.column(name).to_pylist()}
            elif name.endswith("Event:message"):
                texts |= {row[0]["text"] for row in batch.column(name).to_pylist()}
    assert len(decoded) == len(rows)
    for row in rows:
        for name in COLUMNS:
            expected = row[name]
            value = np.asarray(decoded[row["sequence"]][name], expected.dtype)
            assert np.array_equal(value, expected, equal_nan=expected.dtype.kind == "f"), name
    assert texts == {event.text for event in EVENTS}
