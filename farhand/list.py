"""`farhand list`: the robots that are online, and who holds them; it only listens."""

import json
import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from channel.zenoh_link import ZenohNode, ZenohSettings
from farhand.console import ERR, OUT, user_errors
from farhand.dashboard import As
from farhand.feed import DASHBOARD
from site_runtime.daemon import Connect
from site_runtime.keys import lease_key
from site_runtime.lease_messages import RemoteStatus, decode_status
from site_runtime.security.endpoints import Endpoint
from site_runtime.security.identity import Identity, Role, SecurityError
from site_runtime.security.network import meet_as_observer
from site_runtime.session import load_session

EXIT_NOTHING_ONLINE = 1
_CAPACITY = 1000
_POLL_S = 0.05


def list_robots(
    place: Annotated[
        str,
        typer.Argument(
            metavar="SESSION.toml|ENDPOINT",
            help="Whose robots: a session file's, or all at a router or site, tcp/HOST:PORT.",
        ),
    ],
    connect: Connect = None,
    observer: As = DASHBOARD,
    wait: Annotated[
        float, typer.Option("--wait", help="How long to listen [s].", min=0.1, max=60)
    ] = 3.0,
    as_json: Annotated[bool, typer.Option("--json", help="As one JSON array.")] = False,
) -> None:
    """Show the robots that are online: state, task dimension, who holds each, round trip."""
    with user_errors():
        settings, key = _where(place, connect, observer)
        with closing(ZenohNode(settings)) as node:
            ear = node.subscriber(key, _CAPACITY)
            online: dict[str, RemoteStatus] = {}
            end_s = time.monotonic() + wait
            while time.monotonic() < end_s:
                for _, payload in ear.receive():
                    if (status := decode_status(payload)) is not None:
                        online[f"{status.session}/{status.epoch}"] = status
                time.sleep(_POLL_S)
    robots = [online[name] for name in sorted(online)]
    if as_json:
        typer.echo(json.dumps([asdict(robot) for robot in robots], indent=2))
    elif robots:
        OUT.print(_table(robots))
    else:
        ERR.print(f"no robot is online at {place}", highlight=False, markup=False)
    if not robots:
        raise typer.Exit(EXIT_NOTHING_ONLINE)


def _where(place: str, connect: list[str] | None, observer: str) -> tuple[ZenohSettings, str]:
    if Path(place).suffix == ".toml":
        session = load_session(Path(place))
        meeting = meet_as_observer(session, Identity(observer), connect)
        return meeting.settings, lease_key(session.name)
    endpoint = Endpoint("ENDPOINT", place)
    if endpoint.encrypted:
        raise SecurityError(
            f"{place}: name the session file, which says whose certificate to show; an endpoint "
            "without certificates reads tcp/HOST:PORT"
        )
    region = {"region_name": Role.OBSERVER.value}
    return ZenohSettings(connect=(place,), configuration=region), lease_key("*")


def _table(robots: Sequence[RemoteStatus]) -> Table:
    table = Table(title="robots online", title_justify="left")
    for heading in ("session", "state", "task", "held by", "for", "waiting", "round trip"):
        table.add_column(heading)
    for robot in robots:
        trip = "" if robot.round_trip_s is None else f"{robot.round_trip_s * 1e3:.1f} ms"
        held = "" if robot.held_s is None or robot.holder is None else f"{robot.held_s:.0f} s"
        holder = robot.holder or ("nobody" if robot.leased else "whoever is first")
        waiting = ", ".join(sorted(robot.refused))
        table.add_row(
            robot.session, robot.state, f"{robot.dimension}-D", holder, held, waiting, trip
        )
    return table
