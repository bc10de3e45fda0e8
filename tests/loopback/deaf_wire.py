"""TCP between a site and a router that can keep a Zenoh connection up and carry nothing over it."""

import socket
import threading
from contextlib import suppress

_KEEP_ALIVE = b"\x01\x00\x04"  # a batch of one byte, the transport message of that number


class DeafWire:
    """Passes batches between whoever connects and `target`; once `cut`, keep-alives in their place.

    As where Zenoh has merged a new connection with a dying one: connected, and dead one way. Each
    connection from then on passes all again.
    """

    def __init__(self, target: int) -> None:
        self._target = target
        self._server = socket.create_server(("127.0.0.1", 0))
        self.port = int(self._server.getsockname()[1])
        self.connections = 0
        self._sockets: list[socket.socket] = []
        self._deaf: list[dict[bool, threading.Event]] = []
        threading.Thread(target=self._accept, daemon=True).start()

    def cut(self, *, inwards: bool) -> None:
        """Carry nothing more to who connected (`inwards`), or from him."""
        for deaf in self._deaf:
            deaf[inwards].set()

    def close(self) -> None:
        for one in (self._server, *self._sockets):
            with suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)
            one.close()

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                caller, _ = self._server.accept()
                try:
                    called = socket.create_connection(("127.0.0.1", self._target))
                except OSError:
                    caller.close()
                    continue
                self.connections += 1
                self._sockets += [caller, called]
                deaf = {True: threading.Event(), False: threading.Event()}
                self._deaf.append(deaf)
                for source, sink, inwards in ((caller, called, False), (called, caller, True)):
                    threading.Thread(
                        target=_carry, args=(source, sink, deaf[inwards]), daemon=True
                    ).start()


def _carry(source: socket.socket, sink: socket.socket, deaf: threading.Event) -> None:
    with suppress(OSError), source.makefile("rb") as stream:
        while len(head := stream.read(2)) == 2:  # the length of a batch
            batch = stream.read(int.from_bytes(head, "little"))
            sink.sendall(_KEEP_ALIVE if deaf.is_set() else head + batch)
    with suppress(OSError):
        sink.shutdown(socket.SHUT_RDWR)
