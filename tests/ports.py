"""Ports for tests: each test has its own, so that several may run at once."""

import socket


def free_port(kind: int = socket.SOCK_STREAM) -> int:
    """Return a port that nobody has on this machine now; in a fresh namespace neither.

    TCP, or UDP if `kind` is SOCK_DGRAM.
    """
    with socket.socket(type=kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
