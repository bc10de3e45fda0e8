"""A daemon's keys: the operator's requests from the terminal that it runs in."""

import os
import select
import signal
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
        if self._before is None:
            return
        self._thread.join(timeout=1.0)
        if _in_foreground():
            termios.tcsetattr(sys.stdin, termios.TCSADRAIN, self._before)  # type: ignore[arg-type]

    def _read(self) -> None:
        # a read from the background would stop the whole process; so it fails instead
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTTIN})
        terminal = sys.stdin.fileno()
        while not self._ended.is_set():
            if not select.select([terminal], [], [], _LOOK_S)[0]:
                continue
            if not _in_foreground():  # the keys are for another
                self._ended.wait(_LOOK_S)
                continue
            try:
                pressed = os.read(terminal, 64)
            except OSError:  # the terminal is gone, or another's since that look
                self._ended.wait(_LOOK_S)
                continue
            if not pressed:
                return
            self._act(pressed)

    def _act(self, pressed: bytes) -> None:
        """Do what these keys ask, together: several come at once if this thread had to wait."""
        # an arrow key begins with Esc too; to stop at it is the safe reading, and what follows is
        # part of it
        if b"e" in pressed or b"\x1b" in pressed:
            self._requests.stop()
            return
        for key in pressed:
            if key == ord(" "):
                self._requests.toggle_clutch()
            elif key == ord("r"):
                self._requests.reset()


def _in_foreground() -> bool:
    """Whether this process may read its terminal; one in the background would be stopped."""
    try:
        return os.tcgetpgrp(sys.stdin.fileno()) == os.getpgrp()
    except OSError:
        return False
