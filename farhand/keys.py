"""`farhand keys`: the identities of a session, made, renewed, revoked and shown."""

from collections.abc import Iterable
from datetime import timedelta
from pathlib import Path
from typing import Annotated, Any, TypeAlias

import typer
from typer.core import TyperGroup

from farhand.console import OUT, user_errors
from farhand.feed import DASHBOARD
from site_runtime.daemon import SessionPath
from site_runtime.keys import SiteId
from site_runtime.security.authority import Authority, create_authority, open_authority
from site_runtime.security.credentials import KEY_FILE, NEAR, read_credentials
from site_runtime.security.endpoints import Endpoint
from site_runtime.security.identity import (
    AUTHORITY,
    PEOPLE,
    ROUTER,
    SITES,
    Identity,
    Role,
    SecurityError,
)
from site_runtime.security.network import keys_folder
from site_runtime.session import Session, load_session

Hosts: TypeAlias = Annotated[
    list[str] | None,
    typer.Option(
        "--host",
        metavar="NAME=HOST",
        help="One more host name or address of a party, e.g. remote=robot.example; repeatable.",
    ),
]
Names: TypeAlias = Annotated[
    list[str], typer.Argument(metavar="NAME...", help="As in `show`: remote, operator.alice, …")
]


class _MakesByDefault(TyperGroup):
    """`keys SESSION.toml` is `keys make SESSION.toml`."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:  # noqa: ANN401  typer hides it
        """Put the command in where none is named."""
        if args and args[0] not in {*self.commands, "--help"}:
            args = ["make", *args]
        return super().parse_args(ctx, args)


keys = typer.Typer(
    name="keys",
    cls=_MakesByDefault,
    no_args_is_help=True,
    add_completion=False,
    help="Certificates of a session's parties: SESSION.toml makes them; renew, revoke, show.",
)


@keys.command()
def make(
    session: SessionPath,
    observer: Annotated[
        list[str] | None,
        typer.Option("--observer", metavar="NAME", help="A dashboard or recorder; repeatable."),
    ] = None,
    operator: Annotated[
        list[str] | None,
        typer.Option(
            "--operator",
            metavar="NAME",
            help="Who may be at the local site, one at a time; instead of `local`; repeatable.",
        ),
    ] = None,
    supervisor: Annotated[
        list[str] | None,
        typer.Option(
            "--supervisor",
            metavar="NAME",
            help="An operator who may take the robot from another; repeatable.",
        ),
    ] = None,
    host: Hosts = None,
) -> None:
    """Make an authority, and certificates of both sites, the router and observers; keep others."""
    with user_errors():
        loaded = load_session(session)
        folder = keys_folder(loaded)
        observers = [Identity(name) for name in observer or [DASHBOARD]]
        for one in observers:
            if one.role is not Role.OBSERVER:
                raise SecurityError(f"{one.name} is no observer: choose another name")
        people = [Identity(f"{Role.OPERATOR}.{name}") for name in operator or []]
        people += [Identity(f"{Role.SUPERVISOR}.{name}") for name in supervisor or []]
        new = not (folder / AUTHORITY / KEY_FILE).exists()
        if new and (there := _places(folder)):
            raise SecurityError(
                f"{folder} has keys of {', '.join(there)} but not the authority that made them: "
                f"bring it back as {folder / AUTHORITY}, or name another folder in network.keys"
            )
        known = () if new else open_authority(folder).identities
        _require_one_each([*people, *known])
        named = people or any(one.role in PEOPLE for one in known)
        at_local = people if named else [SITES[SiteId.LOCAL]]
        wanted = [*at_local, SITES[SiteId.REMOTE], ROUTER, *observers]
        hosts = _hosts(loaded, host or [], wanted)
        authority = create_authority(folder, loaded.name) if new else open_authority(folder)
        allowed = authority.allowed
        for identity in wanted:
            if identity in authority.identities:
                _say(f"{identity.name}: is there already")
            else:
                _say(f"{identity.name}: {authority.issue(identity, hosts[identity])}")
        _say(
            f"\nMade in {folder}: a folder for each party, to be copied to its machine and to no "
            "other."
        )
        if new:
            _say(
                f"{folder / AUTHORITY} can make anybody's certificate. Move it to a medium that is "
                "kept under lock,\nand bring it back to renew and to revoke."
            )
        elif authority.allowed != allowed:
            _say(_SPREAD)
        if loaded.network.security != "mtls":
            _say(
                f'\nIn [network] of {session}:\n  security = "mtls"\n'
                f'  keys = "{folder.name}"\nand endpoints that begin with tls/ or quic/.'
            )


@keys.command()
def renew(session: SessionPath, names: Names, host: Hosts = None) -> None:
    """Make new certificates. An old one stays good until it expires, unless it was revoked."""
    with user_errors():
        loaded, authority = _open(session)
        identities = _known(authority, names)
        hosts = _hosts(loaded, host or [], identities)
        allowed = authority.allowed
        for identity in identities:
            _say(f"{identity.name}: {authority.issue(identity, hosts[identity])}")
        _say(f"Copy {_folders(authority, identities)} to where they are used, and restart there.")
        if authority.allowed != allowed:
            _say(_SPREAD)


@keys.command()
def revoke(session: SessionPath, names: Names) -> None:
    """Let certificates be refused from the next start of every party on."""
    with user_errors():
        _, authority = _open(session)
        for identity in _known(authority, names):
            _say(f"{authority.revoke(identity)} is revoked")
        _say(_SPREAD)


@keys.command()
def show(session: SessionPath) -> None:
    """Show the certificates that are in the keys folder, and when they expire."""
    with user_errors():
        folder = keys_folder(load_session(session))
        places = _places(folder)
        if not places:
            raise SecurityError(f"{folder} holds no keys: `farhand keys {session}` makes them")
        for name in places:
            found = read_credentials(folder, Identity(name))
            hosts = f" · {', '.join(found.hosts)}" if found.hosts else ""
            style = "red" if found.revoked or found.left() < timedelta() else None
            if style is None and found.left() < NEAR:
                style = "yellow"
            state = "REVOKED" if found.revoked else _left(found.left())
            _say(f"{found.common_name}: {state}, {found.expires:%Y-%m-%d}{hosts}", style)
            _say(f"  SHA-256 {found.fingerprint}")


_SPREAD = (
    "Copy every party's allowed.json to its machine, and restart what runs there: each reads it "
    "when it starts."
)


def _places(folder: Path) -> list[str]:
    """Name the parties whose folders are here."""
    found = folder.iterdir() if folder.is_dir() else ()
    return sorted(place.name for place in found if place.is_dir() and place.name != AUTHORITY)


def _open(path: Path) -> tuple[Session, Authority]:
    session = load_session(path)
    return session, open_authority(keys_folder(session))


def _known(authority: Authority, names: Iterable[str]) -> list[Identity]:
    identities = [Identity(name) for name in names]
    known = ", ".join(one.name for one in authority.identities)
    for identity in identities:
        if identity not in authority.identities:
            raise SecurityError(f"{identity.name} has no certificate here; there are {known}")
    return identities


def _require_one_each(identities: Iterable[Identity]) -> None:
    """Refuse a person who would be operator and supervisor: the lease knows people by name."""
    roles: dict[str, Role] = {}
    for one in identities:
        if one.person is not None and roles.setdefault(one.person, one.role) is not one.role:
            raise SecurityError(f"{one.person} is operator or supervisor, not both")


def _hosts(
    session: Session, given: Iterable[str], identities: Iterable[Identity]
) -> dict[Identity, list[str]]:
    """Return the hosts of each: those in the session's endpoints, and those given by option."""
    network = session.network
    endpoints = {
        "local": (network.local_listen,),
        "remote": (network.remote_listen, network.local_connect),
        "router": (network.router,) if network.router else (),
    }
    hosts: dict[Identity, list[str]] = {}
    for identity in identities:
        place = "local" if identity.role in PEOPLE else identity.name
        named = [Endpoint("", text) for text in endpoints.get(place, ())]
        hosts[identity] = [one.host for one in named if not one.unspecified]
    for text in given:
        name, separator, host = text.partition("=")
        identity = Identity(name)
        if not (separator and host) or identity not in hosts or identity.role is Role.OBSERVER:
            raise SecurityError(
                f"--host {text}: write NAME=HOST, of a site or the router that is made or renewed"
            )
        hosts[identity].append(host)
    return hosts


def _folders(authority: Authority, identities: Iterable[Identity]) -> str:
    return ", ".join(str(authority.folder / identity.name) for identity in identities)


def _left(left: timedelta) -> str:
    if left < timedelta():
        return "EXPIRED"
    return f"{left.days} days left"


def _say(line: str, style: str | None = None) -> None:
    OUT.print(line, style=style, highlight=False, markup=False, soft_wrap=True)
