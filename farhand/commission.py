"""`farhand commission-quanser`."""

import select
import sys
import time
from dataclasses import fields, is_dataclass
from typing import Annotated, Literal

import typer
from rich.markup import escape

from farhand.console import say, user_errors
from hardware.interface import DeviceConfigurationError
from hardware.quanser import QuanserSettings
from hardware.quanser_commissioning import Commissioning, JointSigns, Probe, toml_snippet
from site_runtime.daemon import SessionPath
from site_runtime.keys import SiteId
from site_runtime.session import load_session


def commission_quanser(
    session: SessionPath,
    site: Annotated[Literal["local", "remote"], typer.Option("--site", help="Which site's robot.")],
    current_a: Annotated[
        float, typer.Option("--current-a", help="Largest probing current [A].", min=0.001)
    ] = Probe().current_a,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask before motors move.")] = False,
) -> None:
    """Find the signs of a Quanser robot's encoders and motors; the arm must be free."""
    with user_errors():
        loaded = load_session(session)
        settings = quanser_settings(loaded.site(SiteId[site.upper()]).device, site)
        found = []
        with Commissioning(
            settings, Probe(current_a=current_a), _enter_pressed, time.monotonic_ns, time.sleep
        ) as commissioning:
            say("Ctrl-C ends this at once, amplifiers off; on a terminal, so does Enter.")
            signs = []
            for joint in range(commissioning.joints):
                commissioning.rest()
                say(f"[bold]joint {joint + 1}[/bold]: turn it by hand in its positive direction")
                signs.append(commissioning.encoder_sign(joint))
                say(f"  its encoder counts {'up' if signs[-1] > 0 else 'down'}; let go")
            say(f"now the motors move, with at most {current_a:g} A, one after the other")
            if not yes:
                typer.confirm("Is the arm free, nobody in reach, the stop at hand?", abort=True)
            for joint, sign in enumerate(signs):
                found.append(commissioning.signs(joint, sign))
                _tell(joint, found[-1])
    say(escape(toml_snippet(tuple(found))))


def quanser_settings(device: object, site: str) -> QuanserSettings:
    """Return the Quanser settings in a device's table, its own or those of a part of it."""
    if isinstance(device, QuanserSettings):
        return device
    if is_dataclass(device):
        for item in fields(device):
            part = getattr(device, item.name)
            if isinstance(part, QuanserSettings):
                return part
    raise DeviceConfigurationError(
        f'{site}.device has driver = "{getattr(device, "driver", "?")}"; this command is for '
        f'"quanser"'
    )


def _tell(joint: int, signs: JointSigns) -> None:
    moved = ", ".join(f"{rad:+.3f}" for rad in signs.forward_rad)
    say(
        f"[bold]joint {joint + 1}[/bold]: moved at {signs.forward_a:.3f} A and "
        f"{signs.backward_a:.3f} A; under the first the encoders moved by {escape(f'[{moved}]')} "
        f"rad, as they count"
    )


def _enter_pressed() -> bool:
    return sys.stdin.isatty() and bool(select.select([sys.stdin], [], [], 0.0)[0])
