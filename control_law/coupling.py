"""The coupling ΩP(e): the only way a position error enters a torque."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from control_law.saturation import Arctangent

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Coupling:
    """ΩP(·) of (6), the same at both sites. `omega` is the diagonal of Ω, (z,), positive."""

    omega: FloatArray
    saturation: Arctangent

    def __post_init__(self) -> None:
        if self.omega.shape != self.saturation.amplitude.shape:
            raise ValueError(
                f"omega {self.omega.shape} and the saturation "
                f"{self.saturation.amplitude.shape} must have one entry per task axis"
            )
        if not (np.isfinite(self.omega).all() and (self.omega > 0).all()):
            raise ValueError(f"omega {self.omega} must be positive and finite")

    @classmethod
    def paper(cls, omega: FloatArray, b: FloatArray) -> "Coupling":
        """Return the paper's coupling Ω_j b_j atan(e_j), 0 < b_j ≤ 1."""
        return cls(omega, Arctangent.paper(b))

    @classmethod
    def from_stiffness(
        cls, stiffness_n_per_m: FloatArray, force_ceiling_n: FloatArray
    ) -> "Coupling":
        """Return K_j δ_j atan(e_j/δ_j) with δ_j = 2F_j/(πK_j): stiffness K, force below F."""
        width = 2.0 * force_ceiling_n / (np.pi * stiffness_n_per_m)
        return cls(stiffness_n_per_m, Arctangent(width, width))

    def force(self, error: FloatArray) -> FloatArray:
        """Return ΩP(e) [N] for a position error [m], (z,)."""
        return self.omega * self.saturation(error)

    def energy(self, error: FloatArray) -> float:
        """Return Σ Ω_j ∫₀^{e_j} p_j [J], V₂ of (10)."""
        return float(self.omega @ self.saturation.integral(error))

    @property
    def stiffness(self) -> FloatArray:
        """K_j = Ω_j p_j′(0) [N/m], the steepest the coupling gets, (z,)."""
        return self.omega * self.saturation.slope

    @property
    def force_ceiling(self) -> FloatArray:
        """Ω_j N_j [N], (z,)."""
        return self.omega * self.saturation.bound
