"""A daemon's keys: the operator's requests from the terminal that it runs in."""

import os
import select
import sys
import termios
import threading
import tty
from types import TracebackType

from site_runtime.operator_requests import OperatorRequests

HELP = "keys: space opens and closes the clutch, e or Esc is the emergency stop, r resets"
_LOOK_S = 0.1


class TerminalKeys:
    """Reads single keys, from a thread of its own, while `with` lasts; without a terminal, none.

    The thread waits in the kernel and competes with the loop for a few microseconds a key.
    """

    def __init__(self, requests: OperatorRequests) -> None:
        self._requests = requests
        self._actions = {
            b" ": requests.toggle_clutch,
            b"e": requests.stop,
            b"\x1b": requests.stop,
            b"r": requests.reset,
        }
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._read, name="keys", daemon=True)
        self._before: list[object] | None = None

    @property
    def listening(self) -> bool:
        """Whether there is a terminal to listen to."""
        return self._before is not None

    def __enter__(self) -> "TerminalKeys":
        if sys.stdin is not None and sys.stdin.isatty() and _in_foreground():
            self._before = termios.tcgetattr(sys.stdin)
            tty.setcbreak(sys.stdin)
            self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._ended.set()
        if self._before is not None:
            self._thread.join(timeout=1.0)
            termios.tcsetattr(sys.stdin, termios.TCSADRAIN, self._before)  # type: ignore[arg-type]

    def _read(self) -> None:
        terminal = sys.stdin.fileno()
        while not self._ended.is_set():
            if not select.select([terminal], [], [], _LOOK_S)[0]:
                continue
            pressed = os.read(terminal, 64)
            if not pressed:
                return  # the terminal is gone
            # an arrow key begins with Esc too; to stop at it is the safe reading
            action = self._actions.get(pressed[:1])
            if action is not None:
                action()


def _in_foreground() -> bool:
    """Whether this process may read its terminal; one in the background would be stopped."""
    try:
        return os.tcgetpgrp(sys.stdin.fileno()) == os.getpgrp()
    except OSError:
        return False
