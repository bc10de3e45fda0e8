"""Ports for tests: each test has its own, so that several may run at once."""

import socket


def free_port() -> int:
    """Return a TCP port that nobody has on this machine now; in a fresh namespace neither."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
