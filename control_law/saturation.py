"""The bounded function P through which a position error becomes a force."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Arctangent:
    """p_j(x) = a_j·atan(x/w_j): odd, increasing, bounded, concave for x > 0, |p_j(x)| ≤ |x|.

    Amplitude a and width w, both (z,), positive, a ≤ w (slope at the origin at most 1).
    Section III, after (6).
    """

    amplitude: FloatArray
    width: FloatArray

    def __post_init__(self) -> None:
        if self.amplitude.ndim != 1 or self.amplitude.shape != self.width.shape:
            raise ValueError(
                f"amplitude {self.amplitude.shape} and width {self.width.shape} must both be (z,)"
            )
        if not (np.isfinite(self.amplitude).all() and (self.amplitude > 0).all()):
            raise ValueError(f"amplitude {self.amplitude} must be positive and finite")
        if not (np.isfinite(self.width).all() and (self.width > 0).all()):
            raise ValueError(f"width {self.width} must be positive and finite")
        if (self.amplitude > self.width).any():
            raise ValueError(
                f"slope {self.slope} exceeds 1, so |p(x)| ≤ |x| fails: widen {self.width} "
                f"or lower the amplitude {self.amplitude}"
            )

    @classmethod
    def paper(cls, b: FloatArray) -> "Arctangent":
        """Return the paper's example p_j(x) = b_j·atan(x), 0 < b_j ≤ 1."""
        return cls(b, np.ones_like(b))

    def __call__(self, x: FloatArray) -> FloatArray:
        """Return P(x), (z,)."""
        return self.amplitude * np.arctan(x / self.width)

    def derivative(self, x: FloatArray) -> FloatArray:
        """Return p_j′(x_j), (z,)."""
        return self.slope / (1.0 + np.square(x / self.width))

    def integral(self, x: FloatArray) -> FloatArray:
        """Return ∫₀^{x_j} p_j, (z,)."""
        ratio = x / self.width
        area = ratio * np.arctan(ratio) - 0.5 * np.log1p(np.square(ratio))
        return self.amplitude * self.width * area

    @property
    def slope(self) -> FloatArray:
        """ℓ_j = p_j′(0), the Lipschitz constant of p_j, (z,)."""
        return self.amplitude / self.width

    @property
    def bound(self) -> FloatArray:
        """N_j = sup p_j, (z,)."""
        return self.amplitude * (np.pi / 2)
