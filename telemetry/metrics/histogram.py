"""Counts of values by size, as Prometheus takes them."""

import numpy as np
import numpy.typing as npt
from prometheus_client.utils import floatToGoString

FloatArray = npt.NDArray[np.float64]


class Histogram:
    """Every value counted in the bucket of the smallest bound that it does not exceed."""

    def __init__(self, bounds: tuple[float, ...]) -> None:
        self._bounds = np.array(bounds)
        self._counts = np.zeros(len(bounds) + 1, np.int64)
        self.sum = 0.0

    def add(self, values: FloatArray) -> None:
        """Count values (n,); those that are not finite are left out."""
        values = values[np.isfinite(values)]
        buckets = np.searchsorted(self._bounds, values)
        self._counts += np.bincount(buckets, minlength=len(self._counts))
        self.sum += float(values.sum())

    @property
    def buckets(self) -> list[tuple[str, float]]:
        """Each bound with the number of values up to it."""
        names = [*map(floatToGoString, self._bounds), "+Inf"]
        return list(zip(names, np.cumsum(self._counts).tolist(), strict=True))
