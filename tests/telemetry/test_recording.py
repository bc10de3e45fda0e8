import re
import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from rerun.chunk import McapReader

from telemetry.piece import Piece
from telemetry.recording import Gap, RecordingSource, RecordingWriter, read_recording
from telemetry.ros_messages import decode_event, dtype_of, encode_event, encode_rows, row_schema
from telemetry.row_ring import ARRIVAL, SiteEvent
from telemetry.rows import COLUMNS, RowArray, TelemetryError, row_dtype

OFFSET_NS = 1_700_000_000_000_000_000
EVENTS = (SiteEvent(1_000, "READY"), SiteEvent(2_000, "FAULT: ∫ failed"))


def source(joints: int = 3, dimension: int = 2, epoch: str = "9") -> RecordingSource:
    metadata = {"session": "demo", "epoch": epoch}
    return RecordingSource("remote", joints, dimension, OFFSET_NS, "format = 1\n# µ\n", metadata)


def some_rows(count: int, joints: int = 3, dimension: int = 2, first: int = 0) -> RowArray:
    """Rows of any bits at all, NaN with every payload among them, numbered from `first`."""
    dtype = row_dtype(joints, dimension)
    random = np.random.default_rng(first)
    rows = np.frombuffer(random.bytes(count * dtype.itemsize), dtype).copy()
    rows["q"][::3] = np.nan
    rows["sequence"] = np.arange(first, first + count)
    rows["stamp_ns"] = 1_000_000 * rows["sequence"].astype(np.int64)
    return rows


def arrivals_for(rows: RowArray) -> RowArray:
    """Two datagrams of any bits for every row."""
    arrivals = np.zeros(2 * len(rows), ARRIVAL)
    arrivals["row"] = np.repeat(rows["sequence"], 2)
    arrivals["number"] = 2 * arrivals["row"] + np.tile((0, 1), len(rows))
    arrivals["length"] = 156
    arrivals["data"] = np.random.default_rng(5).integers(0, 256, arrivals["data"].shape)
    return arrivals


def record(path: Path, rows: RowArray, chunk: int = 50, epoch: str = "9") -> Path:
    writer = RecordingWriter(path, source(rows["q"].shape[1], rows["position_m"].shape[1], epoch))
    for start in range(0, len(rows), chunk):
        part = rows[start : start + chunk]
        writer.write(Piece(part, EVENTS if start == 0 else (), arrivals_for(part)))
        writer.flush()
    writer.close()
    return path


@pytest.mark.parametrize(("joints", "dimension"), [(1, 2), (3, 2), (7, 3), (16, 3)])
def test_rows_come_back_bit_by_bit(tmp_path: Path, joints: int, dimension: int) -> None:
    rows = some_rows(333, joints, dimension)
    [(site, back)] = read_recording(record(tmp_path / "a.mcap", rows)).items()
    assert site == "remote"
    assert back.rows.dtype == rows.dtype
    assert back.rows.tobytes() == rows.tobytes()
    assert back.events == EVENTS
    parts = [arrivals_for(rows[start : start + 50]) for start in range(0, len(rows), 50)]
    assert np.array_equal(back.arrivals, np.concatenate(parts))
    assert back.metadata["session"] == "demo"
    assert back.session_text == "format = 1\n# µ\n"
    assert back.complete
    assert back.gaps == ()
    assert back.wall_times_ns[3] == OFFSET_NS + 3_000_000


@pytest.mark.parametrize(("joints", "dimension"), [(2, 2), (3, 2), (7, 3)])
def test_messages_are_cdr_by_its_own_rules(joints: int, dimension: int) -> None:
    rows = some_rows(2, joints, dimension)
    for row, message in zip(rows, encode_rows(rows), strict=True):
        assert message[:4] == b"\0\1\0\0"
        body, place = message[4:], 0
        for name in COLUMNS:
            values = np.atleast_1d(row[name])
            size = values.dtype.itemsize
            place += -place % size
            code = {"u": "BHIQ", "i": "bhiq"}.get(values.dtype.kind, "__fd")
            code = code[size.bit_length() - 1]
            read = struct.unpack_from(f"<{len(values)}{code}", body, place)
            assert np.array(read, values.dtype).tobytes() == values.tobytes(), name
            place += size * len(values)
        assert place == len(body)


def test_the_schema_tells_every_unit_and_meaning_and_is_enough_to_read_by() -> None:
    schema = row_schema(3, 2)
    for name, column in COLUMNS.items():
        assert re.search(
            rf"^\w+(\[\d+\])? {name}  # \[{re.escape(column.unit)}\] {re.escape(column.meaning)}$",
            schema,
            re.MULTILINE,
        ), name
    assert dtype_of(schema) == row_dtype(3, 2)
    other = dtype_of("# old\nuint8 state # x\n\nfloat32[4] q\n")
    assert other == np.dtype([("state", "u1"), ("q", "<f4", (4,))])


@pytest.mark.parametrize("line", ["string text", "float64[] q", "float64", "float64[3] q dot"])
def test_a_schema_of_anything_but_numbers_is_refused(line: str) -> None:
    with pytest.raises(TelemetryError, match=re.escape(line)):
        dtype_of(line)


@given(stamp_ns=st.integers(-(2**63), 2**63 - 1), text=st.text(st.characters(codec="utf-8")))
def test_events_come_back(stamp_ns: int, text: str) -> None:
    event = SiteEvent(stamp_ns, text)
    assert decode_event(encode_event(event)) == event


def test_the_format_s_own_reader_reads_all(tmp_path: Path) -> None:
    rows = some_rows(120)
    with record(tmp_path / "a.mcap", rows).open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        found = list(reader.iter_messages("/remote/rows"))
        assert [message.log_time for _, _, message in found] == (
            OFFSET_NS + rows["stamp_ns"]
        ).tolist()
        assert [message.sequence for _, _, message in found] == list(range(120))
        schema, channel, _ = found[0]
        assert schema is not None
        assert (schema.name, schema.encoding) == ("farhand/msg/RemoteRow", "ros2msg")
        assert channel.message_encoding == "cdr"
        events = [message.data for _, _, message in reader.iter_messages("/remote/events")]
        assert [decode_event(data) for data in events] == list(EVENTS)
        [session] = reader.iter_attachments()
        assert (session.name, session.data) == ("session.toml", b"format = 1\n# \xc2\xb5\n")
        [metadata] = reader.iter_metadata()
        assert metadata.metadata["joints"] == "3"


def test_rerun_decodes_every_field(tmp_path: Path) -> None:
    rows = some_rows(100)
    path = record(tmp_path / "a.mcap", rows)
    decoded = {}
    for chunk in McapReader(path).stream():
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            if name.endswith("RemoteRow:message"):
                decoded |= {row[0]["sequence"]: row[0] for row in batch.column(name).to_pylist()}
    assert len(decoded) == len(rows)
    for row in rows:
        fields = decoded[row["sequence"]]
        for name in COLUMNS:
            assert np.array_equal(
                np.array(fields[name]), row[name], equal_nan=row[name].dtype.kind == "f"
            ), name


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, bytes, RowArray]:
    rows = some_rows(200)
    path = record(tmp_path_factory.mktemp("cut") / "a.mcap", rows, chunk=20)
    return path, path.read_bytes(), rows


def read_bytes(folder: Path, data: bytes) -> tuple[RowArray, bool]:
    path = folder / "damaged.mcap"
    path.write_bytes(data)
    recording = read_recording(path)["remote"]
    return recording.rows, recording.complete


def test_a_file_cut_anywhere_is_read_to_its_last_whole_chunk(
    whole: tuple[Path, bytes, RowArray],
) -> None:
    path, content, rows = whole
    random = np.random.default_rng(1)
    for cut in random.integers(0, len(content), 200):
        zeros = int(random.choice([0, 5, 4096]))  # a power failure leaves them
        try:
            read, complete = read_bytes(path.parent, content[:cut] + bytes(zeros))
        except TelemetryError:
            assert cut < 3_000  # within what comes before the first chunk
            continue
        assert not complete
        assert len(read) % 20 == 0
        assert read.tobytes() == rows[: len(read)].tobytes()
        assert len(read) / len(rows) > cut / len(content) - 0.2


def test_a_session_file_that_was_cut_is_not_taken_for_a_whole_one(
    whole: tuple[Path, bytes, RowArray],
) -> None:
    path, content, _ = whole
    start = content.index(b"format = 1")
    damaged = path.with_name("damaged.mcap")
    for cut in range(start, start + 30):
        damaged.write_bytes(content[:cut])
        assert read_recording(damaged)["remote"].session_text in ("", "format = 1\n# µ\n")


def test_a_changed_byte_never_makes_other_rows(whole: tuple[Path, bytes, RowArray]) -> None:
    path, content, rows = whole
    known = {row.tobytes() for row in rows}
    random = np.random.default_rng(2)
    for place in random.integers(3_000, len(content) - 6_000, 200):
        damaged = bytearray(content)
        damaged[place] ^= int(random.integers(1, 256))
        read, _ = read_bytes(path.parent, bytes(damaged))
        assert all(row.tobytes() in known for row in read)


def test_before_the_first_chunk_there_are_no_rows(tmp_path: Path) -> None:
    RecordingWriter(tmp_path / "a.mcap", source()).abandon()
    recording = read_recording(tmp_path / "a.mcap")["remote"]
    assert recording.rows.dtype == row_dtype(3, 2)
    assert len(recording.rows) == 0
    assert not recording.complete


def test_segments_join_and_gaps_are_located(tmp_path: Path) -> None:
    rows = some_rows(300)
    paths = [
        record(tmp_path / "a.mcap", rows[:100]),
        record(tmp_path / "b.mcap", np.concatenate((rows[107:200], rows[201:]))),
    ]
    recording = read_recording(*paths)["remote"]
    assert recording.gaps == (Gap(100, 7), Gap(200, 1))
    assert len(recording.rows) == 292


def test_segments_of_different_runs_do_not_join(tmp_path: Path) -> None:
    paths = [record(tmp_path / f"{epoch}.mcap", some_rows(3), epoch=epoch) for epoch in ("1", "2")]
    with pytest.raises(TelemetryError, match="another run"):
        read_recording(*paths)


@pytest.mark.parametrize("content", [b"", b"not a recording", b"\x89MCAP0\r\n"])
def test_other_files_are_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(content)
    with pytest.raises(TelemetryError, match="no recording"):
        read_recording(path)
    with pytest.raises(TelemetryError, match="absent"):
        read_recording(tmp_path / "absent.mcap")


def test_an_existing_file_is_never_overwritten(tmp_path: Path) -> None:
    path = record(tmp_path / "a.mcap", some_rows(5))
    with pytest.raises(FileExistsError):
        RecordingWriter(path, source())
    assert len(read_recording(path)["remote"].rows) == 5


def test_the_page_s_ten_lines_read_the_rows(tmp_path: Path) -> None:
    rows = some_rows(77, 3, 2)
    path = record(tmp_path / "rows.mcap", rows)
    page = (Path(__file__).parents[2] / "docs" / "recording.md").read_text(encoding="utf-8")
    [code] = [c for c in re.findall(r"```python\n(.*?)```", page, re.DOTALL) if "make_reader" in c]
    code = code.replace('"rows.mcap"', repr(str(path))).replace("/local/", "/remote/")
    names: dict[str, RowArray] = {}
    exec(code, names)  # noqa: S102 - the page's own
    assert names["rows"].dtype.names == rows.dtype.names
    for name in COLUMNS:
        assert names["rows"][name].tobytes() == rows[name].tobytes()
