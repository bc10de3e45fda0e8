"""Zenoh: the link between the sites, and the way telemetry leaves. The only file that imports it.

No Python callback anywhere: everything arrives in rings that the reader drains, so that no thread
of ours ever competes with the control loop for the interpreter.
"""

import json
import re
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

import zenoh

from channel.link import LinkError

_T = TypeVar("_T")
_REOPEN_S = 0.5  # between two tries
_KEEP_ALIVES = 20  # a lease; a connection given up is gone after one of these parts
_CLOSE_S = 2.0  # closing over a network that swallows everything takes Zenoh 10 s
_QUEUE_BATCHES = 16  # of 64 KiB, the most Zenoh allows
_PRESENCE = "present"

_RingSubscriber: TypeAlias = zenoh.Subscriber[zenoh.handlers.Handler[zenoh.Sample]]


@dataclass(frozen=True, slots=True)
class ZenohSettings:
    """Where to meet. Peers do not forward for each other: to hear both sites, connect to both.

    Endpoints are Zenoh's, such as "tcp/192.168.1.2:7447". `lease_ms` is how long the other side
    waits in silence before it takes this one for gone; nodes of a higher `tier` are waited for a
    quarter of it longer each. The tier is 0 for a node that none dials, else one more than that of
    all that dial it: who is dialled has then given a dead connection up well before it is dialled
    anew. Where both do so at once, Zenoh may merge the new connection with the dying one, which
    leaves one direction dead for good (zenoh issue 2806). `open_timeout_ms` is how long a handshake
    may take; over UDP nothing repeats a lost one before it is over.

    `config_file` is a Zenoh configuration of
    the user's own (routers, TLS, access control), taken as it is, lease too; only endpoints given
    here override it. `configuration` is set over either, by Zenoh's paths: certificates, access
    control.
    """

    listen: tuple[str, ...] = ()
    connect: tuple[str, ...] = ()
    lease_ms: int = 500
    open_timeout_ms: int = 2000
    tier: int = 0
    config_file: str | None = None
    configuration: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.lease_ms < 1:
            raise ValueError(f"lease_ms = {self.lease_ms} is not allowed: it must be at least 1 ms")
        if self.open_timeout_ms < 1:
            raise ValueError(
                f"open_timeout_ms = {self.open_timeout_ms} is not allowed: it must be at least 1 ms"
            )


class ZenohLink:
    """One site's end of the link; made by `ZenohNode.link`."""

    def __init__(
        self, session: zenoh.Session, own_key: str, peer_key: str | None, capacity: int
    ) -> None:
        self._own_key = own_key
        self._peer_key = peer_key
        self._asked_key = peer_key
        self._capacity = capacity
        self._closed = False
        self._present: set[str] = set()
        self._declaring = threading.Lock()
        self._subscriber: _RingSubscriber | None = None
        self._presence: _RingSubscriber | None = None
        self.attach(session)

    def attach(self, session: zenoh.Session) -> None:
        """Declare all anew on another session; the loop may go on meanwhile."""
        with self._declaring:
            self._session = session
            self._hear()
            self._speak()

    def listen_to(self, peer_key: str | None) -> None:
        """Listen to another peer from now on, or to none; not for the loop, which may go on.

        Nothing of the one before arrives once this returns. What cannot be declared, since the node
        is just opened anew, is declared as soon as it is.
        """
        with self._declaring:
            self._peer_key = peer_key
            self._asked_key = peer_key or self._asked_key
            before = [self._subscriber, self._presence]
            self._subscriber = self._presence = None
            _bounded(*(one.undeclare for one in before if one is not None))
            with suppress(zenoh.ZError):
                self._hear()

    def _speak(self) -> None:
        session, own_key = self._session, self._own_key
        self._publisher = session.declare_publisher(
            own_key,
            congestion_control=zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.REAL_TIME,
            express=True,
            reliability=zenoh.Reliability.BEST_EFFORT,
        )
        # one token a run: the end of a killed one, noticed late, must not hide its successor
        self._token = session.liveliness().declare_token(f"{own_key}/{_PRESENCE}/{session.zid()}")

    def _hear(self) -> None:
        self._present.clear()
        if self._peer_key is None:
            return
        session, ring = self._session, zenoh.handlers.RingChannel
        self._subscriber = session.declare_subscriber(self._peer_key, ring(self._capacity))
        self._presence = session.liveliness().declare_subscriber(
            f"{self._peer_key}/{_PRESENCE}/*", ring(64), history=True
        )

    def send(self, data: bytes) -> bool:
        """Publish `data`, dropping it rather than waiting; False once closed.

        True means handed over: Zenoh does not tell whether anyone listens, or what it drops.
        """
        if self._closed:
            return False
        try:
            self._publisher.put(data)
        except zenoh.ZError:
            return False
        return True

    def receive(self) -> list[bytes]:
        """Return what the ring holds, oldest first, and empty it."""
        subscriber = self._subscriber
        if self._closed or subscriber is None:
            return []
        return [sample.payload.to_bytes() for sample in _drain(subscriber)]

    def peer_present(self) -> bool:
        """Whether a peer has announced itself and not gone; a cut shows after its lease."""
        presence = self._presence
        if self._closed or presence is None:
            return False
        for sample in _drain(presence):
            run = str(sample.key_expr)
            if sample.kind == zenoh.SampleKind.PUT:
                self._present.add(run)
            else:
                self._present.discard(run)
        return bool(self._present)

    def ask_for_peer(self, within_s: float) -> bool | None:
        """Ask the other ends of the connections whether they know of the peer: a question and back.

        None if not all have answered within the time. Asks for the last peer while listening to
        none, and answers False while there was none. Not for the loop: it waits.
        """
        if self._closed or self._asked_key is None:
            return False
        known = False
        try:
            replies = self._session.liveliness().get(
                f"{self._asked_key}/{_PRESENCE}/*",
                handler=zenoh.handlers.FifoChannel(64),
                timeout=within_s,
            )
            for reply in replies:
                if reply.err is not None:  # "Timeout"
                    return None
                known = True
        except zenoh.ZError:  # closed meanwhile
            return None
        return known

    def close(self) -> None:
        """Leave the link; the node stays open."""
        if self._closed:
            return
        self._closed = True
        hearing = [one for one in (self._presence, self._subscriber) if one is not None]
        _bounded(
            self._token.undeclare,
            self._publisher.undeclare,
            *(one.undeclare for one in hearing),
        )


class Subscription:
    """A ring of what others publish; made by `ZenohNode.subscriber`."""

    def __init__(self, session: zenoh.Session, key_expression: str, capacity: int) -> None:
        self._key_expression = key_expression
        self._capacity = capacity
        self._closed = False
        self.attach(session)

    def attach(self, session: zenoh.Session) -> None:
        """Declare it anew on another session."""
        self._subscriber = session.declare_subscriber(
            self._key_expression, zenoh.handlers.RingChannel(self._capacity)
        )

    def receive(self) -> list[tuple[str, bytes]]:
        """Return (key, payload) of what arrived since the last call, oldest first. Never blocks."""
        if self._closed:
            return []
        return [(str(s.key_expr), s.payload.to_bytes()) for s in _drain(self._subscriber)]

    def close(self) -> None:
        """Stop listening. Idempotent, never raises."""
        if not self._closed:
            self._closed = True
            _bounded(self._subscriber.undeclare)


class _Telling:
    """Publishes bytes for people; made by `ZenohNode.publisher`."""

    def __init__(self, session: zenoh.Session, key: str) -> None:
        self._key = key
        self._closed = False
        self.attach(session)

    def attach(self, session: zenoh.Session) -> None:
        self._publisher = session.declare_publisher(
            self._key,
            congestion_control=zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.DATA_LOW,
        )

    def __call__(self, data: bytes) -> None:
        if self._closed:
            return
        try:
            self._publisher.put(data)
        except zenoh.ZError:
            return  # closed between the two lines


class ZenohNode:
    """One process's place in the Zenoh network: one session, and what is declared on it."""

    def __init__(self, settings: ZenohSettings) -> None:
        """Open the session; LinkError if an endpoint is malformed, unknown or taken.

        A peer that is not there yet is no error: Zenoh keeps trying to connect.
        """
        if not (settings.listen or settings.connect or settings.config_file):
            raise LinkError(
                "nowhere to meet: give an endpoint to listen on or to connect to, "
                "such as tcp/192.168.1.2:7447, or a Zenoh configuration file"
            )
        self._settings = settings
        self._closed = False
        self._reopening = threading.Lock()
        self._open: list[ZenohLink | Subscription | _Telling] = []
        try:
            config = _config(settings)
            self._dialled_ports = _ports(config.get_json("connect/endpoints"))
            self._needs_all = config.get_json("mode") != '"client"'
            self._session = zenoh.open(config)
        except zenoh.ZError as error:
            raise LinkError(_advice(settings, error)) from error

    def link(self, own_key: str, peer_key: str | None, capacity: int = 64) -> ZenohLink:
        """Return a link that publishes on `own_key` and listens to `peer_key`, or to nobody.

        Its ring keeps the newest `capacity` datagrams. More would outlast a longer stall, but the
        tick that ends it must take them all in, some 13 µs each.
        """
        link = self._declare(lambda: ZenohLink(self._session, own_key, peer_key, capacity))
        self._open.append(link)
        return link

    def publisher(self, key: str) -> Callable[[bytes], None]:
        """Return a function that publishes bytes on `key` for people: low priority, may drop.

        It never blocks and never raises, after `close` too. Keep payloads below 256 KiB: of much
        longer ones the queue cannot hold all fragments, and they never arrive.
        """
        publisher = self._declare(lambda: _Telling(self._session, key))
        self._open.append(publisher)
        return publisher

    def subscriber(self, key_expression: str, capacity: int) -> Subscription:
        """Return a subscription to `key_expression` that keeps the newest `capacity` payloads."""
        subscription = self._declare(lambda: Subscription(self._session, key_expression, capacity))
        self._open.append(subscription)
        return subscription

    def partners(self) -> tuple[str, ...]:
        """Return who is connected: the name in the certificate, or else the address."""
        if self._closed:
            return ()
        try:
            links = self._session.info.links()
        except zenoh.ZError:  # being opened anew
            return ()
        names = {str(link.zid): link.auth_identifier or str(link.dst) for link in links}
        return tuple(sorted(names.values()))

    def dialled(self) -> bool:
        """Whether all that this node dials is connected (a client's one router); False if nothing.

        A connection shows until its lease is over, and so does one that carries nothing.
        """
        try:
            links = self._session.info.links()
        except zenoh.ZError:  # closed meanwhile
            return False
        up = self._dialled_ports & {port for link in links for port in _ports(link.dst)}
        return bool(up) and (up == self._dialled_ports or not self._needs_all)

    def reopen(self) -> None:
        """Leave the network and join it again as another; what is declared stays in use.

        Sending drops and nothing arrives meanwhile; tries until it succeeds or the node is closed.
        For a connection that is dead though Zenoh shows it. Not for the loop.
        """
        with self._reopening:
            if self._closed:
                return
            _bounded(self._session.close)
            while not self._closed:
                try:
                    self._session = zenoh.open(_config(self._settings))
                except zenoh.ZError:  # the endpoint is not free yet
                    time.sleep(_REOPEN_S)
                    continue
                for declared in self._open:
                    declared.attach(self._session)
                return

    def close(self) -> None:
        """Close the session and all that is on it, within seconds. Idempotent, never raises.

        Call it last, with the device stopped: a dead network makes it wait.
        """
        if self._closed:
            return
        self._closed = True
        for declared in self._open:
            declared._closed = True  # the session undeclares them all at once
        reopened = self._reopening.acquire(timeout=_CLOSE_S)  # a router that is gone holds it up
        _bounded(self._session.close)
        if reopened:
            self._reopening.release()

    def _declare(self, declare: Callable[[], _T]) -> _T:
        try:
            return declare()
        except zenoh.ZError as error:
            raise LinkError(f"Zenoh refuses to declare a key: {_brief(error)}") from error


def _config(settings: ZenohSettings) -> zenoh.Config:
    config = zenoh.Config()
    if settings.config_file is not None:
        if not Path(settings.config_file).is_file():
            raise LinkError(f"config_file = {settings.config_file!r} does not exist")
        config = zenoh.Config.from_file(settings.config_file)
    for key, value in _values(settings).items():
        config.insert_json5(key, json.dumps(value))
    return config


def _values(settings: ZenohSettings) -> dict[str, Any]:
    """Return what is set over Zenoh's defaults, or over the user's file, by Zenoh's paths."""
    values: dict[str, Any] = {}
    if settings.config_file is not None:
        if settings.listen:
            values["listen/endpoints"] = settings.listen
        if settings.connect:
            values["connect/endpoints"] = settings.connect
    else:
        values = {
            "mode": "peer",
            # also when empty: Zenoh's default listens on every interface
            "listen/endpoints": settings.listen,
            "connect/endpoints": settings.connect,
            "connect/timeout_ms": -1,
            "connect/exit_on_failure": False,
            "connect/retry": {
                "period_init_ms": 100,
                "period_max_ms": 1000,
                "period_increase_factor": 1.5,
            },
            "scouting/multicast/enabled": False,
            "scouting/gossip/enabled": False,
            # do not hold up the start for peers that come later anyway
            "open/return_conditions/connect_scouted": False,
            "timestamping/enabled": False,
            "transport/shared_memory/enabled": False,
            "transport/unicast/open_timeout": settings.open_timeout_ms,
            "transport/unicast/accept_timeout": settings.open_timeout_ms,
            "transport/link/tx/lease": settings.lease_ms * (4 + settings.tier) // 4,
            "transport/link/tx/keep_alive": _KEEP_ALIVES,
            # a full queue drops at once instead of holding the loop for a millisecond; in return it
            # must hold a burst: two batches, the default, lose paced packets and any long payload
            "transport/link/tx/queue/congestion_control/drop/wait_before_drop": 0,
            "transport/link/tx/queue/size/real_time": _QUEUE_BATCHES,
            "transport/link/tx/queue/size/data_low": _QUEUE_BATCHES,
        }
    return values | dict(settings.configuration)


def stock_configuration(settings: ZenohSettings) -> str:
    """Return these settings as JSON for a program of Zenoh's own, such as zenohd."""
    tree: dict[str, Any] = {}
    for path, value in _values(settings).items():
        *tables, key = path.split("/")
        holder = tree
        for table in tables:
            holder = holder.setdefault(table, {})
        holder[key] = value
    return json.dumps(tree, indent=2)


def _ports(text: str) -> set[str]:
    return set(re.findall(r':(\d+)(?:[?#][^"]*)?(?="|$)', text))


def _drain(subscriber: "_RingSubscriber") -> list[zenoh.Sample]:
    samples: list[zenoh.Sample] = []
    try:
        while (sample := subscriber.try_recv()) is not None:
            samples.append(sample)
    except zenoh.ZError:
        pass  # closed meanwhile
    return samples


def _bounded(*actions: Callable[[], object]) -> None:
    def run() -> None:
        for action in actions:
            try:
                action()
            except zenoh.ZError:
                continue  # going away is all that was wanted

    thread = threading.Thread(target=run, name="zenoh-close", daemon=True)
    thread.start()
    thread.join(_CLOSE_S)


def _advice(settings: ZenohSettings, error: zenoh.ZError) -> str:
    where = ", ".join(
        f"{name} = {endpoints}"
        for name, endpoints in (
            ("listen", list(settings.listen)),
            ("connect", list(settings.connect)),
            ("config_file", settings.config_file),
        )
        if endpoints
    )
    return (
        f"cannot open Zenoh with {where}: {_brief(error)}. An endpoint reads protocol/host:port; "
        "one to listen on needs an address of this machine and a port no other program has"
    )


def _brief(error: zenoh.ZError) -> str:
    return str(error).split(" at /")[0]  # without the source positions of Zenoh's build
