"""How the commands speak to a person."""

from collections.abc import Iterator
from contextlib import contextmanager

import typer
from rich.console import Console

from channel.link import LinkError
from experiments.runner import RunnerError
from hardware.interface import HardwareError
from site_runtime.session import SessionError
from telemetry.rows import TelemetryError

OUT = Console()
ERR = Console(stderr=True)

EXIT_USER_ERROR = 2


@contextmanager
def user_errors() -> Iterator[None]:
    """Turn what a user can mend into a message and exit code 2; anything else stays a traceback."""
    try:
        yield
    except (SessionError, HardwareError, LinkError, TelemetryError, RunnerError, OSError) as error:
        # soft: a path is there to be copied
        ERR.print(str(error), style="red", highlight=False, markup=False, soft_wrap=True)
        raise typer.Exit(EXIT_USER_ERROR) from None


def say(line: str) -> None:
    """Print one line of markup, however long: keys and numbers are there to be copied."""
    OUT.print(line, soft_wrap=True, highlight=False)
