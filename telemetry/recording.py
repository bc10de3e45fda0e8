"""One recording of one site: an MCAP file with its rows, arrivals, events and what explains them.

A file that ends anywhere is read up to its last whole chunk. Described in docs/recording.md.
"""

import errno
import os
import struct
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from mcap.exceptions import McapError
from mcap.records import Attachment, Channel, Footer, Message, Metadata, Schema
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer
from zstandard import ZstdError

from telemetry.piece import NO_ARRIVALS, Piece
from telemetry.ros_messages import (
    ARRIVALS_SCHEMA,
    EVENT_SCHEMA,
    MESSAGE_ENCODING,
    SCHEMA_ENCODING,
    decode_arrivals,
    decode_event,
    decode_rows,
    dtype_of,
    encode_arrivals,
    encode_event,
    encode_rows,
    row_schema,
)
from telemetry.row_ring import SiteEvent
from telemetry.rows import RowArray, TelemetryError, row_dtype

METADATA: Final = "farhand"
SESSION_FILE: Final = "session.toml"
NAMED: Final = " "
"""Stands between `SESSION_FILE` and the key, in the name of an attachment that the key names."""

_KEYS: Final = frozenset({"site", "joints", "dimension", "wall_offset_ns"})


@dataclass(frozen=True, slots=True)
class RecordingSource:
    """Whose rows a recording holds; `metadata` is free text about the run.

    `session_files` are the files that the session names, by their keys in it.
    `wall_offset_ns` put on a stamp gives the wall clock as it was when the run started.
    """

    site: str
    joints: int
    dimension: int
    wall_offset_ns: int
    session_text: str
    metadata: Mapping[str, str]
    session_files: Mapping[str, bytes] = field(default_factory=dict)


class RecordingWriter:
    """A new recording; raises OSError as the file does.

    What `flush` has written stays readable whatever happens to this process. After an OSError, only
    `abandon` is left to be called.
    """

    def __init__(self, path: Path, source: RecordingSource) -> None:
        self._offset_ns = source.wall_offset_ns
        self._events = 0
        self._arrivals = 0
        self._arrivals_at_ns = 0
        self._file = _File(path)
        self._writer = writer = Writer(self._file, compression=CompressionType.ZSTD)  # type: ignore[arg-type]
        writer.start()
        kind = f"farhand/msg/{source.site.capitalize()}"
        self._row_channel = self._channel(
            f"/{source.site}/rows", f"{kind}Row", row_schema(source.joints, source.dimension)
        )
        self._event_channel = self._channel(f"/{source.site}/events", f"{kind}Event", EVENT_SCHEMA)
        self._arrivals_channel = self._channel(
            f"/{source.site}/arrivals", "farhand/msg/Arrivals", ARRIVALS_SCHEMA
        )
        told = {
            "site": source.site,
            "joints": str(source.joints),
            "dimension": str(source.dimension),
            "wall_offset_ns": str(source.wall_offset_ns),
        }
        writer.add_metadata(METADATA, dict(source.metadata) | told)
        writer.add_attachment(0, 0, SESSION_FILE, "application/toml", source.session_text.encode())
        for key, data in source.session_files.items():
            writer.add_attachment(
                0, 0, SESSION_FILE + NAMED + key, "application/octet-stream", data
            )
        try:
            writer.flush()  # type: ignore[no-untyped-call]
        except OSError:
            self.abandon()
            path.unlink()
            raise

    def write(self, piece: Piece) -> None:
        """Add what was recorded next; it is in the file after the next `flush`."""
        rows = piece.rows
        stamps_ns = self._log_times(rows["stamp_ns"])
        numbers = (rows["sequence"] % 2**32).tolist()
        for message, at, number in zip(encode_rows(rows), stamps_ns, numbers, strict=True):
            self._writer.add_message(self._row_channel, at, message, at, number)
        if len(piece.arrivals):
            # they have no time of their own: that of their rows, or of the last ones before
            self._arrivals_at_ns = stamps_ns[-1] if stamps_ns else self._arrivals_at_ns
            at, message = self._arrivals_at_ns, encode_arrivals(piece.arrivals)
            self._writer.add_message(self._arrivals_channel, at, message, at, self._arrivals)
            self._arrivals += 1
        for event in piece.events:
            at = max(event.stamp_ns + self._offset_ns, 0)
            self._writer.add_message(self._event_channel, at, encode_event(event), at, self._events)
            self._events += 1

    def flush(self) -> None:
        """Put all that was added into the file, as a whole chunk."""
        self._writer.flush()  # type: ignore[no-untyped-call]

    def close(self) -> None:
        """Write the index and close the file."""
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._file.flush()
        self._file.close()

    def abandon(self) -> None:
        """Close the file as it is after the last `flush` that succeeded."""
        self._file.close()

    def _channel(self, topic: str, name: str, schema: str) -> int:
        schema_id = self._writer.register_schema(name, SCHEMA_ENCODING, schema.encode())
        return self._writer.register_channel(topic, MESSAGE_ENCODING, schema_id)

    def _log_times(self, stamps_ns: Any) -> list[int]:  # noqa: ANN401  numpy integers (r,)
        times: list[int] = np.maximum(stamps_ns + self._offset_ns, 0).tolist()
        return times


class _File:
    """A file whose bytes come into it by `flush` alone, all of them or none."""

    def __init__(self, path: Path) -> None:
        self._descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        self._length = 0
        self._buffer = bytearray()

    def write(self, data: bytes) -> int:
        self._buffer += data
        return len(data)

    def tell(self) -> int:
        return self._length + len(self._buffer)

    def flush(self) -> None:
        if os.fstat(self._descriptor).st_nlink == 0:
            raise FileNotFoundError(errno.ENOENT, "the file being written was deleted")
        written = 0
        try:
            while written < len(self._buffer):
                # a copy, since a view would keep the buffer from being emptied after an error
                written += os.write(self._descriptor, bytes(self._buffer[written:]))
        except OSError:
            with suppress(OSError):
                os.ftruncate(self._descriptor, self._length)
            raise
        self._length += written
        self._buffer.clear()

    def close(self) -> None:
        os.close(self._descriptor)


@dataclass(frozen=True, slots=True)
class Gap:
    """Rows that are not in a recording, between some that are."""

    first: int
    rows: int


@dataclass(frozen=True, slots=True)
class Recording:
    """What was recorded of one site: rows bit by bit as they were put, and events, in order.

    `arrivals`, dtype `ARRIVAL`, are all datagrams that the site took from the network.
    `complete` says that every file was closed properly and could be read to its end.
    """

    rows: RowArray
    events: tuple[SiteEvent, ...]
    arrivals: RowArray
    metadata: Mapping[str, str]
    session_text: str
    complete: bool
    session_files: Mapping[str, bytes] = field(default_factory=dict)

    @property
    def gaps(self) -> tuple[Gap, ...]:
        """Rows lost, by sequence."""
        sequence = self.rows["sequence"].astype(np.int64)
        steps = np.diff(sequence)
        return tuple(
            Gap(int(sequence[i]) + 1, int(steps[i]) - 1) for i in np.flatnonzero(steps != 1)
        )

    @property
    def wall_times_ns(self) -> np.ndarray[Any, np.dtype[np.int64]]:
        """Wall clock of every row [ns since 1970], by its offset when the run started."""
        times: np.ndarray[Any, np.dtype[np.int64]] = self.rows["stamp_ns"] + int(
            self.metadata["wall_offset_ns"]
        )
        return times


def read_recording(*paths: Path | str) -> Mapping[str, Recording]:
    """Read the files of a run, segments of a site in their order; return a recording by site.

    TelemetryError if a file is no recording, or two of one site are of different runs.
    """
    found: dict[str, list[Recording]] = {}
    for path in map(Path, paths):
        recording = _read(path)
        parts = found.setdefault(recording.metadata["site"], [])
        if parts and parts[0].metadata != recording.metadata:
            raise TelemetryError(f"{path} is of another run than the files before it")
        parts.append(recording)
    return {site: joined(parts) for site, parts in found.items()}


def joined(parts: Sequence[Recording]) -> Recording:
    """Return segments of one run, in their order, as one recording."""
    return Recording(
        np.concatenate([part.rows for part in parts]),
        tuple(event for part in parts for event in part.events),
        np.concatenate([part.arrivals for part in parts]),
        parts[0].metadata,
        parts[0].session_text,
        all(part.complete for part in parts),
        parts[0].session_files,
    )


def _read(path: Path) -> Recording:
    contents = _Contents()
    complete = False
    try:
        with path.open("rb") as file:
            for record in StreamReader(file, validate_crcs=True).records:
                contents.take(record)
                complete = isinstance(record, Footer)
    except OSError as error:
        raise TelemetryError(f"cannot read the recording {path}: {error}") from error
    except (McapError, ZstdError, struct.error, ValueError):
        complete = False  # cut off here, or not what was written
    if contents.metadata is None or not contents.metadata.keys() >= _KEYS:
        raise TelemetryError(f"{path} is no recording of farhand, or ends before its first row")
    return Recording(
        contents.rows(),
        tuple(decode_event(message) for message in contents.messages("/events")),
        np.concatenate(
            (NO_ARRIVALS, *(decode_arrivals(m) for m in contents.messages("/arrivals")))
        ),
        contents.metadata,
        contents.session_text,
        complete,
        contents.session_files,
    )


class _Contents:
    """What the records of a file, in their order, tell."""

    def __init__(self) -> None:
        self.metadata: Mapping[str, str] | None = None
        self.session_text = ""
        self.session_files: dict[str, bytes] = {}
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._messages: dict[int, list[bytes]] = {}

    def take(self, record: object) -> None:
        if isinstance(record, Message):
            self._messages.setdefault(record.channel_id, []).append(record.data)
        elif isinstance(record, Schema):
            # The first is in a chunk with a checksum; its repetition at the end may be damaged.
            self._schemas.setdefault(record.id, record)
        elif isinstance(record, Channel):
            self._channels.setdefault(record.id, record)
        elif isinstance(record, Metadata) and record.name == METADATA:
            self.metadata = record.metadata
        elif isinstance(record, Attachment) and record.name == SESSION_FILE:
            self.session_text = record.data.decode(errors="replace")
        elif isinstance(record, Attachment) and record.name.startswith(SESSION_FILE + NAMED):
            self.session_files[record.name.removeprefix(SESSION_FILE + NAMED)] = record.data

    def messages(self, topic: str) -> list[bytes]:
        """Messages of the channel whose topic ends so."""
        return [
            message
            for number, channel in self._channels.items()
            if channel.topic.endswith(topic)
            for message in self._messages.get(number, ())
        ]

    def rows(self) -> RowArray:
        for channel in self._channels.values():
            if channel.topic.endswith("/rows"):
                dtype = dtype_of(self._schemas[channel.schema_id].data.decode())
                return decode_rows(self.messages("/rows"), dtype)
        about = self.metadata or {}
        return np.zeros(0, row_dtype(int(about["joints"]), int(about["dimension"])))
