"""What is left of the certificate while the loop runs, and the share of the gains still proven."""

from math import nan

import numpy as np
import numpy.typing as npt

from control_law.certificates import (
    best,
    relaxation_theorem_a,
    relaxation_theorem_b,
    required_scale,
)
from site_runtime.certification import hold_of, site_gains
from site_runtime.keys import SiteId
from site_runtime.parts import coupling_of
from site_runtime.session import Session

FloatArray = npt.NDArray[np.float64]
Relaxations = tuple[FloatArray, FloatArray]


class Margin:
    """Compares the loop's greatest age of late with the round trip that the gains are proven for.

    Stiffness and force ceiling scaled by a share divide both sites' relaxations by it, so every age
    has a share that is proven: 1 within the certified round trip, less beyond. `relaxations` are
    both sites', of each theorem. Without `derate` the share stays 1.
    """

    def __init__(
        self,
        certified_s: float,
        relaxations: tuple[Relaxations, ...],
        period_ns: int,
        *,
        derate: bool,
    ) -> None:
        self.certified_s = certified_s
        self.loop_s = nan
        self._relaxations = relaxations
        self._period_ns = period_ns
        self._derate = derate

    def share(self, loop_bound_ns: int | None) -> float:
        """Return the share that is proven at the channel's bound [ns]; 0 while it is unknown."""
        if loop_bound_ns is None:
            self.loop_s = nan
            return 0.0 if self._derate else 1.0
        # the channel sees ages at ticks; each site's sample ages for one more
        self.loop_s = (loop_bound_ns + 2 * self._period_ns) * 1e-9
        if self.loop_s <= self.certified_s or not self._derate:
            return 1.0
        hold_s = self._period_ns * 1e-9
        return max(
            1.0 / float(required_scale(local_s, remote_s, self.loop_s, hold_s).max())
            for local_s, remote_s in self._relaxations
        )


def margin_of(session: Session) -> Margin:
    """Return the margin of a session, by Theorems A and B."""
    coupling = coupling_of(session.coupling)
    local, remote = (site_gains(session, site) for site in SiteId)
    return Margin(
        best(coupling, local, remote, hold_of(session)).round_trip_s,
        tuple(
            (relaxation(coupling, local), relaxation(coupling, remote))
            for relaxation in (relaxation_theorem_a, relaxation_theorem_b)
        ),
        session.period_ns,
        derate=session.engagement.beyond_certificate == "derate",
    )
