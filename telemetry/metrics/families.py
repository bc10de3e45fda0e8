"""Prometheus metrics by name, whose samples all carry the same labels."""

from collections.abc import Mapping

from prometheus_client import Metric
from prometheus_client.metrics_core import (
    CounterMetricFamily,
    GaugeMetricFamily,
    HistogramMetricFamily,
)

from telemetry.metrics.histogram import Histogram


class MetricFamilies:
    """Makes them; a counter's name gets its `_total` when it is written out."""

    def __init__(self, **labels: str) -> None:
        self._names = tuple(labels)
        self._values = tuple(labels.values())

    def gauge(self, name: str, meaning: str, value: float) -> Metric:
        """Return one number that may rise and fall."""
        family = GaugeMetricFamily(name, meaning, labels=self._names)
        family.add_metric(self._values, value)
        return family

    def gauges(self, name: str, meaning: str, label: str, values: Mapping[str, float]) -> Metric:
        """Return one such number for each value of one more label."""
        family = GaugeMetricFamily(name, meaning, labels=(*self._names, label))
        for key, value in values.items():
            family.add_metric((*self._values, key), value)
        return family

    def counter(self, name: str, meaning: str, value: float) -> Metric:
        """Return one number that rises, from zero at the start of a run."""
        family = CounterMetricFamily(name, meaning, labels=self._names)
        family.add_metric(self._values, value)
        return family

    def counters(self, name: str, meaning: str, label: str, values: Mapping[str, float]) -> Metric:
        """Return one such number for each value of one more label."""
        family = CounterMetricFamily(name, meaning, labels=(*self._names, label))
        for key, value in values.items():
            family.add_metric((*self._values, key), value)
        return family

    def histogram(self, name: str, meaning: str, histogram: Histogram) -> Metric:
        """Return counts by size."""
        family = HistogramMetricFamily(name, meaning, labels=self._names)
        family.add_metric(self._values, histogram.buckets, histogram.sum)
        return family

    def histograms(
        self, name: str, meaning: str, label: str, histograms: Mapping[str, Histogram]
    ) -> Metric:
        """Return counts by size for each value of one more label."""
        family = HistogramMetricFamily(name, meaning, labels=(*self._names, label))
        for key, histogram in histograms.items():
            family.add_metric((*self._values, key), histogram.buckets, histogram.sum)
        return family

    def info(self, name: str, meaning: str, values: Mapping[str, str]) -> Metric:
        """Return a gauge of 1 that has its values as further labels."""
        family = GaugeMetricFamily(name, meaning, labels=(*self._names, *values))
        family.add_metric((*self._values, *values.values()), 1)
        return family
