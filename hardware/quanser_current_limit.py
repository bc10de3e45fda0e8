"""The current that a motor may take: its peak for a while, then what it bears for ever.

Copper heats with i². With h the mean of i² that a first-order filter of the winding's thermal
time constant τ sees, τ ḣ = i² − h, a motor that bears `continuous` for ever bears h ≤ continuous².
From cold, the peak p lasts about τ ln(p² / (p² − c²)) under a continuous c.
"""

import math

FADE_S = 0.1


class CurrentLimit:
    """Two-stage limit of one motor's current [A]: never above the peak, h never above continuous².

    The limit is the current that could be held `FADE_S` longer before h reaches continuous²: from
    the peak it falls to the continuous current in a few such times, not at once.
    """

    def __init__(self, peak_a: float, continuous_a: float, thermal_time_s: float) -> None:
        self._peak_a = peak_a
        self._bearable_a2 = continuous_a**2
        self._time_s = thermal_time_s
        self._share = -math.expm1(-FADE_S / thermal_time_s)
        self._flowing_a = 0.0
        self.heat_a2 = 0.0

    @property
    def limit_a(self) -> float:
        """What may flow from now on, for at most `FADE_S` [A]."""
        most_a2 = self.heat_a2 + (self._bearable_a2 - self.heat_a2) / self._share
        return min(self._peak_a, math.sqrt(max(most_a2, 0.0)))

    def pass_time(self, elapsed_s: float) -> None:
        """Let the current that `apply` returned last flow for this long."""
        weight = -math.expm1(-elapsed_s / self._time_s)
        self.heat_a2 += weight * (self._flowing_a**2 - self.heat_a2)

    def apply(self, wanted_a: float) -> float:
        """Return the nearest current within the limit [A], which flows from now on."""
        limit_a = self.limit_a
        self._flowing_a = min(max(wanted_a, -limit_a), limit_a)
        return self._flowing_a
