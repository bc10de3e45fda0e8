"""Ports for tests: each test has its own, so that several may run at once."""

import itertools
import os
import random
import socket

_FIRST, _A_WORKER = 20_000, 1_500  # below those that a system gives to whoever dials
_WORKER = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw")) % 8
_NEXT = itertools.count(random.randrange(_A_WORKER))  # noqa: S311 - to meet no earlier run's


def free_port(kind: int = socket.SOCK_STREAM) -> int:
    """Return a port that nobody has on this machine now; in a fresh namespace neither.

    TCP, or UDP if `kind` is SOCK_DGRAM. The same one comes again only after a thousand others, so
    that who was killed may have his port anew.
    """
    for number in itertools.islice(_NEXT, _A_WORKER):
        port = _FIRST + _WORKER * _A_WORKER + number % _A_WORKER
        with socket.socket(type=kind) as probe:
            try:
                probe.bind(("127.0.0.1", port))
            except OSError:
                continue
            return port
    raise OSError("no port is free")
