"""Two links in one process, for loopback, simulation and tests."""

from collections import deque


class MemoryLink:
    """One end of a pair; made by `memory_links`."""

    def __init__(self, inbox: deque[bytes], outbox: deque[bytes]) -> None:
        self._inbox = inbox
        self._outbox = outbox
        self._peer: MemoryLink | None = None
        self._closed = False

    def _join(self, peer: "MemoryLink") -> None:
        self._peer = peer

    def send(self, data: bytes) -> bool:
        """Put `data` in the peer's ring; False once either end is closed."""
        if self._closed or not self.peer_present():
            return False
        self._outbox.append(data)
        return True

    def receive(self) -> list[bytes]:
        """Return what the ring holds, oldest first, and empty it."""
        arrived: list[bytes] = []
        # another thread may append meanwhile: popleft is atomic, copy-and-clear is not
        while self._inbox:
            arrived.append(self._inbox.popleft())
        return arrived

    def peer_present(self) -> bool:
        """Whether the other end is open, seen from an open end."""
        return not self._closed and self._peer is not None and not self._peer._closed

    def close(self) -> None:
        """Close this end; what arrived and was not received is gone."""
        self._closed = True
        self._inbox.clear()


def memory_links(capacity: int = 64) -> tuple[MemoryLink, MemoryLink]:
    """Return a connected pair; each ring keeps the newest `capacity` datagrams."""
    if capacity < 1:
        raise ValueError(f"capacity = {capacity} is not allowed: it must be at least 1")
    there: deque[bytes] = deque(maxlen=capacity)
    back: deque[bytes] = deque(maxlen=capacity)
    first, second = MemoryLink(there, back), MemoryLink(back, there)
    first._join(second)
    second._join(first)
    return first, second
