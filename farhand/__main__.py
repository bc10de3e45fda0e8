"""The `farhand` command."""

import typer

from farhand.bench import bench
from farhand.certify import certify
from farhand.commission import commission_quanser
from farhand.dashboard import dashboard
from farhand.demo import demo
from farhand.design import design
from farhand.devices import device_check, devices
from farhand.doctor import doctor
from farhand.export import export
from farhand.info import info
from farhand.keys import keys
from farhand.lease import lease
from farhand.link_test import link_test
from farhand.list import list_robots
from farhand.plot import plot
from farhand.recompute import recompute
from farhand.record import record
from farhand.replay import replay
from farhand.reproduce import reproduce
from farhand.router import router
from farhand.simulate import simulate
from local_site.daemon import local
from remote_site.daemon import remote

app = typer.Typer(
    name="farhand",
    help="Move, and feel through, a robot at another site, over a network whose delay varies.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
for command in (
    local,
    remote,
    router,
    dashboard,
    demo,
    simulate,
    record,
    info,
    replay,
    recompute,
    plot,
    export,
    certify,
    link_test,
    design,
    reproduce,
    bench,
    doctor,
    devices,
    device_check,
    commission_quanser,
):
    app.command()(command)
app.command("list")(list_robots)
app.add_typer(keys)
app.add_typer(lease)


def main() -> None:
    """Run the command line."""
    app()


if __name__ == "__main__":
    main()
