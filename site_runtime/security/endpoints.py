"""Where an endpoint leads, and whether what passes there can be read on the way."""

import ipaddress
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

ENCRYPTED = frozenset({"tls", "quic"})
_WITHIN_THE_MACHINE = frozenset({"unixsock-stream", "unixpipe", "vsock"})


@dataclass(frozen=True, slots=True)
class Endpoint:
    """A Zenoh endpoint, and what named it: a session key or an option."""

    named_by: str
    text: str

    @property
    def protocol(self) -> str:
        """The word before the first slash, such as `tcp` or `quic`."""
        return self.text.split("/", 1)[0]

    @property
    def address(self) -> str:
        """Host and port, without parameters."""
        after = self.text.split("/", 1)[-1]
        return after.split("?", 1)[0].split("#", 1)[0]

    @property
    def host(self) -> str:
        """Name or address, without brackets."""
        return self.address.rpartition(":")[0].strip("[]")

    @property
    def encrypted(self) -> bool:
        """Whether TLS or QUIC."""
        return self.protocol in ENCRYPTED

    @property
    def unspecified(self) -> bool:
        """Whether it stands for every address of a machine, and so names none."""
        try:
            return not self.host or ipaddress.ip_address(self.host).is_unspecified
        except ValueError:
            return self.host == "*"

    @property
    def within_the_machine(self) -> bool:
        """Whether nothing said there leaves the machine."""
        if self.protocol in _WITHIN_THE_MACHINE or self.host == "localhost":
            return True
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return False


def in_the_clear(endpoints: Iterable[Endpoint]) -> Iterator[Endpoint]:
    """Yield the endpoints beyond this machine where anybody on the way can read and write."""
    return (one for one in endpoints if not one.encrypted and not one.within_the_machine)
