"""`farhand lease`: what an operator says of the lease of a remote robot."""

import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from typing import Annotated

import typer

from channel.zenoh_link import ZenohNode
from farhand.console import ERR, OUT, user_errors
from site_runtime.daemon import Connect, Operator, SessionPath
from site_runtime.keys import SiteId, claim_key, lease_key
from site_runtime.lease import Verb, Wish
from site_runtime.lease_messages import Answer, RemoteStatus, decode_status, encode_wish
from site_runtime.security.identity import Identity, Role, SecurityError
from site_runtime.security.network import meet_as_site
from site_runtime.session import load_session

EXIT_REFUSED = 1
ANSWER_S = 15.0
_REPEAT_S = 0.25
_CAPACITY = 100

lease = typer.Typer(
    name="lease",
    no_args_is_help=True,
    add_completion=False,
    help="The lease of a session's remote robot: show, claim, release, give, take.",
)


@lease.command()
def show(session: SessionPath, operator: Operator = None, connect: Connect = None) -> None:
    """Show who holds the robot and who waits for it."""
    with _asking(session, operator, connect) as asking:
        for status in asking.told():
            _say(f"{status.session} is {status.state}, held by {status.holder or 'nobody'}")
            for name, reason in status.refused.items():
                _say(f"  {name} waits: {reason}")
            return


@lease.command()
def claim(session: SessionPath, operator: Operator = None, connect: Connect = None) -> None:
    """Let a local site that runs claim again, after a release."""
    with _asking(session, operator, connect) as asking:
        wish = Wish(Verb.CLAIM, time.time_ns())
        for status in asking.told(wish):
            refused = status.refused.get(asking.person)
            if status.holder == asking.person or refused is not None:
                _say(refused or "you hold it")
                return


@lease.command()
def release(session: SessionPath, operator: Operator = None, connect: Connect = None) -> None:
    """Give the robot up, and claim it no more until `claim` or the local site's next start."""
    _ask(session, operator, connect, Verb.RELEASE)


@lease.command()
def give(
    session: SessionPath,
    to: Annotated[str, typer.Argument(metavar="NAME", help="Who waits for it.")],
    operator: Operator = None,
    connect: Connect = None,
) -> None:
    """Give the robot that you hold to another operator."""
    _ask(session, operator, connect, Verb.GIVE, to)


@lease.command()
def take(session: SessionPath, operator: Operator = None, connect: Connect = None) -> None:
    """Take the robot from whoever holds it: supervisors only."""
    _ask(session, operator, connect, Verb.TAKE)


class _Asking:
    """Talks to the remote site in an operator's name, beside his local site."""

    def __init__(self, node: ZenohNode, session_name: str, person: str) -> None:
        self.person = person
        self._ear = node.subscriber(lease_key(session_name), _CAPACITY)
        self._publish = node.publisher(claim_key(session_name, person))

    def told(self, wish: Wish | None = None) -> Iterator[RemoteStatus]:
        """Yield what the remote tells, repeating a wish meanwhile: it counts once."""
        end_s = time.monotonic() + ANSWER_S
        while time.monotonic() < end_s:
            if wish is not None:
                self._publish(encode_wish(wish))
            time.sleep(_REPEAT_S)
            for _, payload in self._ear.receive():
                if (status := decode_status(payload)) is not None:
                    yield status
        ERR.print("no answer: is the remote site online?", highlight=False, markup=False)
        raise typer.Exit(EXIT_REFUSED)


@contextmanager
def _asking(
    path: SessionPath, operator: str | None, connect: list[str] | None
) -> Iterator[_Asking]:
    with user_errors():
        session = load_session(path)
        meeting = meet_as_site(session, SiteId.LOCAL, [], connect, operator)
        if meeting.person is None:
            raise SecurityError(
                "this session has no operators by name: whoever comes first is obeyed. "
                "`farhand keys SESSION.toml --operator NAME` makes the keys of one"
            )
        with closing(ZenohNode(meeting.settings)) as node:
            yield _Asking(node, session.name, meeting.person)


def _ask(
    path: SessionPath,
    operator: str | None,
    connect: list[str] | None,
    verb: Verb,
    to: str | None = None,
) -> None:
    answer: Answer | None = None
    with _asking(path, operator, connect) as asking:
        if to is not None:
            Identity(f"{Role.OPERATOR}.{to}")  # no other name could be answered
        wish = Wish(verb, time.time_ns(), to)
        for status in asking.told(wish):
            answer = status.answers.get(asking.person)
            if answer is not None and answer.epoch == str(wish.epoch):
                break
    if answer is not None:
        _say(answer.text)
        if not answer.granted:
            raise typer.Exit(EXIT_REFUSED)


def _say(line: str) -> None:
    OUT.print(line, highlight=False, markup=False, soft_wrap=True)
