"""What a dashboard is told of the energy of both sites."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from telemetry.rows import RowArray

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class EnergyTrace:
    """Energies [J] at these times (k,) [ns].

    `functional_j` (k, 3): kinetic, coupling and transit energy of the proof, whose sum must not
    rise in free motion; NaN where the proof does not speak. `injected_j` (k, 2): what hand and
    environment have put in so far. `dissipated_j` (k, 2): what the damping of the local and the
    remote site has taken out.
    """

    times_ns: IntArray
    functional_j: FloatArray
    injected_j: FloatArray
    dissipated_j: FloatArray


class EnergyMeter(Protocol):
    """Follows the energy along consecutive rows of both sites."""

    def update(self, times_ns: IntArray, local: RowArray, remote: RowArray) -> EnergyTrace:
        """Take the rows (k,) of both sites at these times (k,) [ns], one clock, rising."""
        ...
