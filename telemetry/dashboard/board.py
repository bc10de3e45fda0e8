"""The dashboard: what is offered goes to every sink, and none of them can hold up the offerer."""

import socket
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import rerun as rr

from telemetry.dashboard.painter import Arrival, Painter, check_shape, paint
from telemetry.picture import Picture
from telemetry.pump import CAPACITY, Pump
from telemetry.rows import TelemetryError
from telemetry.stream import Batch

SERVER_MEMORY: Final = "64MiB"


@dataclass(frozen=True, slots=True)
class LiveServer:
    """Serves the picture on loopback, to viewers that come and go; see `start_viewer`."""

    port: int = 9876

    @property
    def address(self) -> str:
        """What a viewer connects to."""
        return f"rerun+http://127.0.0.1:{self.port}/proxy"


@dataclass(frozen=True, slots=True)
class RecordingFile:
    """Saves the picture as a file (.rrd) that `rerun FILE` opens."""

    path: Path


Sink = LiveServer | RecordingFile


class Dashboard:
    """Shows batches of both sites on every sink; `offer` never blocks."""

    def __init__(
        self, picture: Picture, sinks: Sequence[Sink], queue_batches: int = CAPACITY
    ) -> None:
        self._picture = picture
        self._pumps = [
            Pump(f"dashboard {sink}", _painter(picture, sink).consume, queue_batches)
            for sink in sinks
        ]

    @property
    def dropped_batches(self) -> int:
        """Batches not shown because a sink was not fast enough."""
        return sum(pump.dropped for pump in self._pumps)

    @property
    def waiting_batches(self) -> int:
        """Batches offered that the slowest sink has not taken up yet."""
        return max((pump.waiting for pump in self._pumps), default=0)

    def stalled_s(self) -> float:
        """How long the slowest sink has been blocked [s]; a health signal."""
        return max((pump.stalled_s() for pump in self._pumps), default=0.0)

    def offer(self, batch: Batch, arrival_ns: int) -> None:
        """Show one batch that arrived at this time [ns, this process' monotonic clock].

        Safe from any thread. TelemetryError if the batch is not of this picture's arms, or a sink
        failed.
        """
        check_shape(self._picture, batch)
        for pump in self._pumps:
            pump.offer((batch, arrival_ns))

    def close(self, timeout_s: float = 5.0) -> bool:
        """Show what is queued and end every sink; False if one is blocked for longer and left."""
        ended = [pump.close(timeout_s) for pump in self._pumps]
        return all(ended)


def save_recording(path: Path, picture: Picture, arrivals: Sequence[Arrival]) -> None:
    """Draw these (batch, arrival [ns]) into a file (.rrd), dropping none; TelemetryError."""
    paint(_painter(picture, RecordingFile(path)), picture, arrivals)


def _painter(picture: Picture, sink: Sink) -> Painter:
    if isinstance(sink, RecordingFile):
        try:
            return Painter(picture, rr.FileSink(sink.path))
        except RuntimeError as error:
            raise TelemetryError(f"cannot write the recording {sink.path}: {error}") from error
    # rerun itself would only log that the port is taken, and serve nothing.
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", sink.port))
        except OSError as error:
            raise TelemetryError(
                f"cannot serve the dashboard on port {sink.port}: {error.strerror}; "
                "is another one running? Choose another port"
            ) from error
    server = rr.GrpcServerSink("127.0.0.1", sink.port, server_memory_limit=SERVER_MEMORY)
    return Painter(picture, server)
