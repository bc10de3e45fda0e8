"""Keys on a pseudo-terminal that a process of its own leads, as a shell's foreground job does."""

import os
import pty
import select
import signal
import subprocess
import sys
import termios
import textwrap
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from site_runtime.operator_requests import CLUTCH, EMERGENCY_STOP, RESET, OperatorRequests
from site_runtime.terminal_keys import TerminalKeys

ROOT = Path(__file__).parents[2]
DEADLINE_S = 20.0

# It prints each request it sees, and ends at the word on its other pipe.
PROGRAM = textwrap.dedent("""
    import os, select, sys, time
    from site_runtime.operator_requests import EMERGENCY_STOP, RESET, OperatorRequests
    from site_runtime.terminal_keys import TerminalKeys

    requests, clutch = OperatorRequests(), False
    orders = int(sys.argv[1])
    with TerminalKeys(requests) as keys:
        print("listening" if keys.listening else "deaf", flush=True)
        while not select.select([orders], [], [], 0.01)[0]:
            asked = requests.take()
            if asked & EMERGENCY_STOP:
                print("stop", flush=True)
            if asked & RESET:
                print("reset", flush=True)
            if requests.clutch is not clutch:
                clutch = requests.clutch
                print("open" if clutch else "closed", flush=True)
    print("over", flush=True)
""")

LEADER = """
import fcntl, os, sys, termios
fcntl.ioctl(0, termios.TIOCSCTTY, 0)
os.execv(sys.argv[1], sys.argv[1:])
"""
BACKGROUND = """
import subprocess, sys
sys.exit(subprocess.call(sys.argv[1:], process_group=0, close_fds=False))
"""
# as a shell does: the job gets the foreground, and loses it at SIGUSR1
SHELL = """
import os, signal, subprocess, sys
signal.signal(signal.SIGTTOU, signal.SIG_IGN)
signal.signal(signal.SIGUSR1, lambda *_: os.tcsetpgrp(0, os.getpgrp()))
take = "import os, signal, sys; os.tcsetpgrp(0, os.getpid());"
take += "signal.signal(signal.SIGTTOU, signal.SIG_DFL); os.execv(sys.argv[1], sys.argv[1:])"
job = [sys.executable, "-c", take, *sys.argv[1:]]
sys.exit(subprocess.call(job, process_group=0, close_fds=False, restore_signals=False))
"""


class Terminal:
    """A pseudo-terminal, and the program with it as its controlling terminal."""

    def __init__(self, *under: str) -> None:
        """`under` are programs that start it, and are its session's leaders."""
        self.ours, theirs = pty.openpty()
        self.theirs = theirs
        self.before = termios.tcgetattr(theirs)
        orders, self._orders = os.pipe()

        program = [sys.executable, "-c", PROGRAM, str(orders)]
        for outer in (*under, LEADER):
            program = [sys.executable, "-c", outer, *program]
        self.process = subprocess.Popen(
            program,
            stdin=theirs,
            stdout=subprocess.PIPE,
            cwd=ROOT,
            pass_fds=(orders,),
            start_new_session=True,
        )
        os.close(orders)

    def says(self) -> str:
        """The next word it prints."""
        assert self.process.stdout is not None
        assert select.select([self.process.stdout], [], [], DEADLINE_S)[0], "it says nothing"
        return self.process.stdout.readline().decode().strip()

    def press(self, keys: bytes) -> None:
        os.write(self.ours, keys)

    def end(self) -> int:
        os.write(self._orders, b".")
        return self.process.wait(DEADLINE_S)

    @property
    def modes(self) -> list:
        return termios.tcgetattr(self.theirs)

    def close(self) -> None:
        self.process.kill()
        self.process.wait()
        assert self.process.stdout is not None
        self.process.stdout.close()
        for end in (self.ours, self.theirs, self._orders):
            os.close(end)


@pytest.fixture
def terminal() -> Iterator[Terminal]:
    terminal = Terminal()
    yield terminal
    terminal.close()


def test_single_keys_act_and_the_terminal_is_as_it_was(terminal: Terminal) -> None:
    assert terminal.says() == "listening"
    assert not terminal.modes[3] & (termios.ICANON | termios.ECHO)
    assert terminal.modes[3] & termios.ISIG  # Ctrl-C is still Ctrl-C
    for key, word in [
        (b" ", "open"), (b" ", "closed"), (b"e", "stop"), (b"r", "reset"), (b"\x1b", "stop"),
        (b"xqR E\x04", "open"),
    ]:  # fmt: skip
        terminal.press(key)
        assert terminal.says() == word
    assert terminal.end() == 0
    assert terminal.says() == "over"
    assert terminal.modes == terminal.before


def test_a_terminal_that_hangs_up_ends_nothing(terminal: Terminal) -> None:
    assert terminal.says() == "listening"
    terminal.process.send_signal(signal.SIGCONT)
    assert terminal.process.poll() is None
    os.close(terminal.ours)
    terminal.ours = os.open(os.devnull, os.O_RDWR)
    # the hangup's own signal ends the program, as it ends a daemon, which catches it
    assert terminal.process.wait(DEADLINE_S) == -signal.SIGHUP


def test_in_the_background_the_terminal_is_not_touched() -> None:
    terminal = Terminal(BACKGROUND)
    try:
        assert terminal.says() == "deaf"
        assert terminal.modes == terminal.before
        terminal.press(b"e\n")
        time.sleep(0.3)
        assert terminal.end() == 0
        assert terminal.says() == "over"
        assert terminal.modes == terminal.before
    finally:
        terminal.close()


def test_sent_to_the_background_it_goes_on_without_keys_and_leaves_the_terminal() -> None:
    terminal = Terminal(SHELL)
    try:
        assert terminal.says() == "listening"
        terminal.press(b"e")
        assert terminal.says() == "stop"
        terminal.process.send_signal(signal.SIGUSR1)
        time.sleep(0.3)
        shells = terminal.modes
        terminal.press(b"r")
        time.sleep(0.5)
        assert terminal.end() == 0
        assert terminal.says() == "over"
        assert terminal.modes == shells
    finally:
        terminal.close()


def test_without_a_terminal_there_is_nothing_to_hear(monkeypatch: pytest.MonkeyPatch) -> None:
    for stdin in (None, open(os.devnull)):  # noqa: SIM115  closed below
        monkeypatch.setattr(sys, "stdin", stdin)
        with TerminalKeys(OperatorRequests()) as keys:
            assert not keys.listening
            assert not keys._thread.is_alive()
        if stdin is not None:
            stdin.close()


@pytest.mark.parametrize(
    ("together", "stop", "reset", "clutch"),
    [
        (b"  ", False, False, False),
        (b" r", False, True, True),
        (b" e", True, False, False),
        (b"re", True, False, False),
        (b"er", True, False, False),
        (b"   \x1b[A", True, False, False),
        (b"\x1bOr", True, False, False),  # a key of the keypad: its r is no reset
        (b"xyz", False, False, False),
    ],
)
def test_of_keys_read_together_none_is_lost_and_a_stop_outweighs_the_rest(
    together: bytes, stop: bool, reset: bool, clutch: bool
) -> None:
    requests = OperatorRequests()
    TerminalKeys(requests)._act(together)
    assert requests.take() == CLUTCH * clutch | EMERGENCY_STOP * stop | RESET * reset
