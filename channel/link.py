"""What carries bytes between the sites, whatever it is made of."""

from collections.abc import Callable
from typing import Protocol


class LinkError(Exception):
    """A link cannot be opened; the message says where and what to try."""


class Link(Protocol):
    """Datagrams both ways, newest first to survive. Nothing here blocks the control loop."""

    def send(self, data: bytes) -> bool:
        """Hand over one datagram; False if it was dropped. Real-time safe, never raises."""
        ...

    def receive(self) -> list[bytes]:
        """Return what arrived since the last call, oldest first. Real-time safe, never raises.

        A bounded ring stands in between: what overflows it drops the oldest.
        """
        ...

    def peer_present(self) -> bool:
        """Whether the far end is there. For people and logs: silence is what safety watches."""
        ...

    def close(self) -> None:
        """Leave. Idempotent, never raises."""
        ...


class TappedLink:
    """A link that shows all it receives to `tap`, which must be real-time safe."""

    def __init__(self, link: Link, tap: Callable[[list[bytes]], None]) -> None:
        self._tap = tap
        self._link = link

    def send(self, data: bytes) -> bool:
        """Hand over one datagram; False if it was dropped."""
        return self._link.send(data)

    def receive(self) -> list[bytes]:
        """Return what arrived since the last call, oldest first."""
        arrived = self._link.receive()
        if arrived:
            self._tap(arrived)
        return arrived

    def peer_present(self) -> bool:
        """Whether the far end is there."""
        return self._link.peer_present()

    def close(self) -> None:
        """Leave."""
        self._link.close()
