"""The `farhand` command. A command's module is imported when it is asked for, and no other."""

from collections.abc import Iterator, Mapping
from importlib import import_module
from typing import Any, Final

import typer
from typer.core import TyperGroup
from typer.main import get_command

COMMANDS: Final = {
    "local": "local_site.daemon:local",
    "remote": "remote_site.daemon:remote",
    "router": "farhand.router:router",
    "dashboard": "farhand.dashboard:dashboard",
    "demo": "farhand.demo:demo",
    "simulate": "farhand.simulate:simulate",
    "record": "farhand.record:record",
    "info": "farhand.info:info",
    "replay": "farhand.replay:replay",
    "recompute": "farhand.recompute:recompute",
    "plot": "farhand.plot:plot",
    "export": "farhand.export:export",
    "certify": "farhand.certify:certify",
    "link-test": "farhand.link_test:link_test",
    "design": "farhand.design:design",
    "reproduce": "farhand.reproduce:reproduce",
    "bench": "farhand.bench:bench",
    "doctor": "farhand.doctor:doctor",
    "devices": "farhand.devices:devices",
    "device-check": "farhand.devices:device_check",
    "commission-quanser": "farhand.commission:commission_quanser",
    "list": "farhand.list:list_robots",
    "keys": "farhand.keys:keys",
    "lease": "farhand.lease:lease",
}
"""Where each command is: a function, or a typer application of its own."""


class _OnDemand(Mapping[str, Any]):
    """The commands by name: a site needs neither the viewer nor the benchmarks in its memory."""

    def __getitem__(self, name: str) -> Any:  # noqa: ANN401  typer hides its commands' type
        module, _, attribute = COMMANDS[name].partition(":")
        found = getattr(import_module(module), attribute)
        if isinstance(found, typer.Typer):
            return get_command(found)
        alone = _typer()
        alone.command(name)(found)
        return get_command(alone)

    def __iter__(self) -> Iterator[str]:
        return iter(COMMANDS)

    def __len__(self) -> int:
        return len(COMMANDS)


class _Group(TyperGroup):
    """A group whose commands come from `COMMANDS`."""

    def __init__(self, **settings: Any) -> None:  # noqa: ANN401  typer's own
        super().__init__(**settings)
        self.commands = _OnDemand()  # type: ignore[assignment]  # none is ever added


def _typer(**settings: Any) -> typer.Typer:  # noqa: ANN401  typer's own
    return typer.Typer(add_completion=False, pretty_exceptions_enable=False, **settings)


app = _typer(name="farhand", cls=_Group, no_args_is_help=True)


@app.callback()
def _about() -> None:
    """Move, and feel through, a robot at another site, over a network whose delay varies."""


def main() -> None:
    """Run the command line."""
    app()


if __name__ == "__main__":
    main()
