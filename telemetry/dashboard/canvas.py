"""One rerun recording whose timeline shows the session's time."""

from collections.abc import Iterable
from typing import Final

import numpy as np
import numpy.typing as npt
import rerun as rr
import rerun.blueprint as rrb
from rerun.sinks import LogSinkLike

IntArray = npt.NDArray[np.int64]
FloatArray = npt.NDArray[np.float64]

APPLICATION: Final = "farhand"
TIMELINE: Final = "t"
FLUSH_S: Final = 60.0

_SCALARS: Final = rr.Scalars.descriptor_scalars()


class Canvas:
    """What a picture is drawn on; times are the observer's [ns], `origin_ns` is session time 0.

    Belongs to one thread, and may block it: a viewer that stalls blocks whoever logs to it.
    """

    def __init__(self, sink: LogSinkLike, blueprint: rrb.Blueprint) -> None:
        self.origin_ns = 0
        self._recording = rr.RecordingStream(APPLICATION)
        self._recording.set_sinks(sink, default_blueprint=blueprint)
        self._column: tuple[IntArray, rr.TimeColumn] | None = None

    def send(self, path: str, times_ns: IntArray, columns: Iterable[rr.ComponentColumn]) -> None:
        """Draw a column of things at these times (k,)."""
        # Many columns share their times, and a time column costs as much as what it indexes.
        if self._column is None or self._column[0] is not times_ns:
            durations = (times_ns - self.origin_ns).astype("timedelta64[ns]")
            self._column = times_ns, rr.TimeColumn(TIMELINE, duration=durations)
        self._recording.send_columns(path, [self._column[1]], columns)

    def plot(self, path: str, times_ns: IntArray, *series: FloatArray) -> None:
        """Draw signals (k,) or (k, m); where one is NaN, its line is broken."""
        values = np.column_stack(series)
        ends = np.arange(0, values.size + 1, values.shape[1], dtype=np.int32)
        # What rr.Scalars.columns makes, for half its time: most that is drawn is drawn here.
        scalars = rr.components.ScalarBatch(values.ravel())
        self.send(path, times_ns, [rr.ComponentColumn(_SCALARS, scalars, offsets=ends)])

    def log(self, path: str, time_ns: int, what: rr.AsComponents) -> None:
        """Draw one thing."""
        duration = np.timedelta64(time_ns - self.origin_ns, "ns")
        self._recording.set_time(TIMELINE, duration=duration)
        self._recording.log(path, what)

    def log_static(self, path: str, what: rr.AsComponents) -> None:
        """Draw what never changes, or the style of what does."""
        self._recording.log(path, what, static=True)

    def send_chunks(self, chunks: Iterable[rr.chunk.Chunk]) -> None:
        """Draw what rerun itself has read."""
        self._recording.send_chunks(chunks)

    def show(self, blueprint: rrb.Blueprint) -> None:
        """Arrange the views."""
        self._recording.send_blueprint(blueprint)

    def close(self) -> None:
        """End the recording, all of it sent."""
        self._recording.flush(timeout_sec=FLUSH_S)
        self._recording.disconnect()
