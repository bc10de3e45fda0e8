"""The energy that must not rise in free motion: a corrected Lyapunov–Krasovskii functional.

(9)–(11) with V₃ mended: the printed (11) puts velocities into P, which does not bound what (14)
needs bounded. With the quadratic V₃ below, V̇ ≤ −Σ s_kᵀ[Λ_k − c_k J_kᵀKJ_k]s_k, where
c_l = ½(α d̄_r + d̄_l/γ) and c_r = ½(γ d̄_l + d̄_r/α). Offline: a test oracle, an energy meter.
"""

from collections import deque
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from control_law.coupling import Coupling

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class SiteMotion:
    """One site at one instant: s (n,), M (n, n), Ẋ (z,)."""

    s: FloatArray
    M: FloatArray
    X_dot: FloatArray


@dataclass(frozen=True, slots=True)
class Energy:
    """V₁ kinetic energy of s, V₂ energy of the coupling, V₃ of the motion in transit [J]."""

    kinetic: float
    coupling: float
    transit: float

    @property
    def total(self) -> float:
        """V = V₁ + V₂ + V₃ [J]."""
        return self.kinetic + self.coupling + self.transit


class LyapunovKrasovskii:
    """V along a motion, one update a step. The past before the first update is at rest.

    α and γ are the same on every axis: gains whose D_l/D_r differs between axes may be certified
    by Theorem B and yet let this V rise.

    V₁ is (9) without the work of the external forces, which the caller adds if there are any.
    V₃ = (1/2α)∫_{−d̄_r}^0∫_{t+γ'}^t Ẋ_rᵀKẊ_r + (1/2γ)∫_{−d̄_l}^0∫_{t+γ'}^t Ẋ_lᵀKẊ_l.
    """

    def __init__(
        self,
        coupling: Coupling,
        max_delay_local_s: float,
        max_delay_remote_s: float,
        alpha: float = 1.0,
        gamma: float = 1.0,
    ) -> None:
        if not (alpha > 0 and gamma > 0):
            raise ValueError(f"alpha {alpha} and gamma {gamma} must be positive")
        self._coupling = coupling
        self._local = _DelayedDoubleIntegral(max_delay_local_s)
        self._remote = _DelayedDoubleIntegral(max_delay_remote_s)
        self._alpha = alpha
        self._gamma = gamma

    def update(
        self, local: SiteMotion, remote: SiteMotion, error: FloatArray, dt_s: float
    ) -> Energy:
        """Return V now, dt after the previous update, at the undelayed error e_l⁰ = X_l − X_r.

        At the first update dt counts for nothing.
        """
        stiffness = self._coupling.stiffness
        in_local = self._local.update(float(stiffness @ np.square(local.X_dot)), dt_s)
        in_remote = self._remote.update(float(stiffness @ np.square(remote.X_dot)), dt_s)
        return Energy(
            kinetic=0.5 * float(local.s @ local.M @ local.s + remote.s @ remote.M @ remote.s),
            coupling=self._coupling.energy(error),
            transit=0.5 * (in_local / self._gamma + in_remote / self._alpha),
        )


class _DelayedDoubleIntegral:
    """∫_{−d̄}^0∫_{t+γ'}^t w dη dγ' of a signal w fed sample by sample, linear in between.

    With W = ∫w and Y = ∫W it is d̄W(t) − Y(t) + Y(t−d̄): two running sums and their past.
    """

    def __init__(self, window_s: float) -> None:
        if not window_s >= 0:
            raise ValueError(f"window {window_s} s must be zero or more")
        self._window_s = window_s
        self._past: deque[tuple[float, float, float, float]] = deque()  # (t, w, W, Y)

    def update(self, w: float, dt_s: float) -> float:
        """Return the double integral with the sample w taken dt after the previous one."""
        past = self._past
        if not past:
            past.append((0.0, w, 0.0, 0.0))
            return 0.0
        t0, w0, W0, Y0 = past[-1]
        W = W0 + 0.5 * dt_s * (w0 + w)
        Y = Y0 + dt_s * (W0 + dt_s * (2.0 * w0 + w) / 6.0)
        t = t0 + dt_s
        past.append((t, w, W, Y))
        start = t - self._window_s
        while len(past) > 1 and past[1][0] <= start:
            past.popleft()
        return self._window_s * W - Y + self._outer_integral_at(start)

    def _outer_integral_at(self, start: float) -> float:
        t0, w0, W0, Y0 = self._past[0]
        if start <= t0:
            return Y0  # exact: W = Y = 0 until the first sample
        h = start - t0
        t1, w1, _, _ = self._past[1]
        return Y0 + h * (W0 + h * (0.5 * w0 + h * (w1 - w0) / (6.0 * (t1 - t0))))
