"""A site's metrics for Prometheus: counted from its rows, served by a process of its own."""
