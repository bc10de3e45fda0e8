"""Rows and events on their way to a disk that may be slow or full: bounded, the oldest dropped."""

import threading
from collections import deque

from telemetry.piece import Piece


class Backlog:
    """A queue of pieces between a thread that fills it and one that empties it."""

    def __init__(self, most_bytes: int) -> None:
        self._most_bytes = most_bytes
        self._pieces: deque[Piece] = deque()
        self._bytes = 0
        self._dropped = 0
        self._lock = threading.Lock()

    @property
    def dropped(self) -> int:
        """Rows dropped so far because there was no room."""
        return self._dropped

    def put(self, piece: Piece) -> None:
        """Add the newest piece; what there is no room for is dropped, the oldest first."""
        with self._lock:
            self._pieces.append(piece)
            self._bytes += piece.nbytes
            while self._bytes > self._most_bytes:
                oldest = self._pieces.popleft()
                self._bytes -= oldest.nbytes
                self._dropped += len(oldest.rows)

    def put_back(self, piece: Piece) -> None:
        """Return what was taken and could not be written; the next `put` looks for its room."""
        with self._lock:
            self._pieces.appendleft(piece)
            self._bytes += piece.nbytes

    def take(self, most_rows: int) -> Piece | None:
        """Take the oldest pieces as one, so many rows or a single piece; None if there is none."""
        taken: list[Piece] = []
        rows = 0
        with self._lock:
            while self._pieces and (not taken or rows + len(self._pieces[0].rows) <= most_rows):
                piece = self._pieces.popleft()
                self._bytes -= piece.nbytes
                rows += len(piece.rows)
                taken.append(piece)
        return Piece.joined(taken) if taken else None
