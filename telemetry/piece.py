"""What is recorded together: consecutive rows, events among them, and what arrived for them."""

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from telemetry.row_ring import ARRIVAL, SiteEvent
from telemetry.rows import RowArray

NO_ARRIVALS: Final = np.zeros(0, ARRIVAL)


class Piece(NamedTuple):
    """Consecutive rows, the events among them, and what arrived for them, dtype `ARRIVAL`."""

    rows: RowArray
    events: tuple[SiteEvent, ...]
    arrivals: RowArray = NO_ARRIVALS

    @property
    def nbytes(self) -> int:
        """Memory that it takes, but for its few events."""
        return self.rows.nbytes + self.arrivals.nbytes

    @classmethod
    def joined(cls, pieces: Sequence["Piece"]) -> "Piece":
        """Make one piece of several, in their order."""
        return cls(
            np.concatenate([piece.rows for piece in pieces]),
            tuple(event for piece in pieces for event in piece.events),
            np.concatenate([piece.arrivals for piece in pieces]),
        )
