"""What carries bytes between the sites, whatever it is made of."""

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
