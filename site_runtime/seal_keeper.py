"""Keeps a site's packets sealed: offers a key, takes the peer's, tells people what was refused."""

import threading
from collections import Counter
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Final

from channel.sealed_link import PacketKeys, Refusal, SealedLink
from channel.zenoh_link import Subscription, ZenohNode
from site_runtime.assembly import TAKEOVER_NS
from site_runtime.clock import Clock
from site_runtime.daemon_log import DaemonLog
from site_runtime.keeper import Keeper
from site_runtime.keys import SiteId, offer_key, state_key
from site_runtime.link_keeper import UNHEARD_S, LinkKeeper
from site_runtime.operator_requests import OperatorRequests
from site_runtime.security.identity import SITES, SecurityError
from site_runtime.security.network import Meeting
from site_runtime.security.offer import Offer, OfferError, OfferReader, OwnOffer
from site_runtime.session import Session
from site_runtime.site import Site

LOOK_S: Final = 0.25
WARN_NS: Final = 10_000_000_000
"""What was refused is told at most so often."""

_OFFERS = 4  # read in one look: each costs a third of a millisecond of the interpreter
_AGAIN_NS = 10_000_000_000  # until an offer that was refused is looked at again
_SETTLE_NS = 3_000_000_000  # in which two runs come to use the same keys


@dataclass(slots=True)
class _Peer:
    """Who may be at the other end: where his offers come, and what came of them."""

    name: str
    ear: Subscription
    payload: bytes = b""
    offer: Offer | None = None
    keys: PacketKeys | None = None
    taken_ns: int = 0
    heard_ns: int | None = None
    refused: bytes = b""
    refused_ns: int = 0
    told: str = ""
    runs: dict[bytes, PacketKeys] = field(default_factory=dict)
    """By offer, with what was opened under each: an earlier run's packets are never new again."""


class SealKeeper(Keeper):
    """Keys for one site's sealed `link`, from a thread of its own, in a `with` statement.

    A run of the peer has a second to be heard, and keeps its place until nothing of it has been
    opened for a second; then another that offers a key is taken for it, as a channel does. While
    this site waits for the lease no packet is for it.
    """

    def __init__(
        self,
        session: Session,
        site: SiteId,
        meeting: Meeting,
        epoch: int,
        node: ZenohNode,
        packets: ZenohNode,
        clock: Clock,
        requests: OperatorRequests,
        log: DaemonLog,
        capacity: int = 64,
    ) -> None:
        """Offers go by `node`, sealed packets by `packets`. SecurityError without certificates."""
        super().__init__("seal", LOOK_S, log)
        credentials = meeting.credentials
        if credentials is None:
            raise SecurityError("packets are sealed between certificates, and here are none")
        self._node = node
        self._packets = packets
        self._clock = clock
        self._requests = requests
        self._own = OwnOffer(site, credentials, session.digest, epoch)
        self._reader = OfferReader(credentials, session.digest)
        self._offer = node.publisher(offer_key(session.name, site, meeting.person))
        people = meeting.people if site is SiteId.REMOTE else ()
        names = credentials.names_allowed()
        self._peers = {
            state_key(session.name, site.peer, one.person): _Peer(
                names[one], node.subscriber(offer_key(session.name, site.peer, one.person), 16)
            )
            for one in people or (SITES[site.peer],)
            if one in names
        }
        # of several people none is heard before one holds the lease
        self._turned = None if people else state_key(session.name, site.peer)
        self._turning = threading.Lock()
        self._link = packets.link(
            state_key(session.name, site, meeting.person), self._turned, capacity
        )
        # carries no packet: who is there, by certificates
        self._presence = node.link(
            state_key(session.name, site, meeting.person),
            state_key(session.name, site.peer, people[0].person if people else None),
        )
        self.link = SealedLink(self._link, self._presence.peer_present)
        self._opened = 0
        self._opened_ns: int | None = None
        self._changed_ns = clock.now_ns()
        self._worried = False
        self._told: Counter[Refusal] = Counter()
        self._told_ns: int | None = None

    def listen_to(self, peer_key: str | None) -> None:
        """Listen to another peer from now on, or to none, and seal for it alone."""
        with self._turning:
            self._turned = peer_key
            self.link.use(None)
            self._link.listen_to(peer_key)
            self._presence.listen_to(peer_key)
            self._apply(self._clock.now_ns())

    def peer_heard(self) -> bool:
        """Whether the peer's run, or of several people's anybody's, has been heard of lately."""
        now_ns = self._clock.now_ns()
        return any(
            one.heard_ns is not None and now_ns - one.heard_ns < UNHEARD_S * 1e9
            for one in self._peers.values()
        )

    def ask_for_peer(self, within_s: float) -> bool | None:
        """Ask whoever is connected, with certificates, whether the peer is there."""
        return self._presence.ask_for_peer(within_s)

    @property
    def waits(self) -> bool:
        """Whether no packet is to come, since nobody has the lease, or not this site."""
        return self._requests.unleased

    def dialled(self) -> bool:
        """Whether all that this site dials is connected; of the packets' once they can flow."""
        flow = self.link.keys is not None and not self.waits
        return self._node.dialled() and (not flow or self._packets.dialled())

    def reopen(self) -> None:
        """Join the network anew, with both nodes: which one is dead cannot be told from here."""
        self._packets.reopen()
        self._node.reopen()

    def look(self) -> None:
        """Offer, take in offers, use what they give, tell people."""
        self._offer(self._own.payload)
        now_ns = self._clock.now_ns()
        if self.link.opened != self._opened:
            self._opened = self.link.opened
            self._opened_ns, self._worried = now_ns, False
        if self.waits:
            self._changed_ns = now_ns
        for key, peer in self._peers.items():
            for _, payload in peer.ear.receive()[-_OFFERS:]:
                self._take(peer, payload, now_ns, in_use=key == self._turned)
            if peer.offer is not None and datetime.now(UTC) >= peer.offer.expires:
                self._log.say(f"the certificate {peer.name} has expired: its packets end", "WARN")
                peer.payload, peer.offer, peer.keys = b"", None, None
        with self._turning:
            self._apply(now_ns)
        self._tell_refused(now_ns)
        self._tell_silence(now_ns)

    def look_failed(self) -> None:
        """Use no keys until looks succeed: nobody knows whether they are still good."""
        self.link.use(None)

    def _take(self, peer: _Peer, payload: bytes, now_ns: int, *, in_use: bool) -> None:
        if payload == peer.payload:
            peer.heard_ns = now_ns
            return
        if peer.keys is not None:
            last_ns = max(peer.taken_ns, (self._opened_ns or 0) if in_use else 0)
            if now_ns - last_ns < TAKEOVER_NS:
                return
        if payload == peer.refused and now_ns - peer.refused_ns < _AGAIN_NS:
            return
        try:
            offer = self._reader.read(payload, peer.name)
            keys = peer.runs.get(offer.signed)
            if keys is None:
                keys = peer.runs[offer.signed] = self._own.keys_with(offer)
            elif peer.keys is not None and peer.keys.greatest:
                raise OfferError("is of an earlier run")
        except OfferError as error:
            peer.refused, peer.refused_ns = payload, now_ns
            text = f"a key offered in the name of {peer.name} is refused: it {error}"
            if text != peer.told:
                peer.told = text
                self._log.say(text, "WARN")
            return
        peer.payload, peer.offer, peer.keys = payload, offer, keys
        peer.taken_ns = peer.heard_ns = now_ns

    def _apply(self, now_ns: int) -> None:
        peer = None if self._turned is None else self._peers.get(self._turned)
        keys = None if peer is None else peer.keys
        if keys is self.link.keys:
            return
        self.link.use(keys)
        self._changed_ns, self._worried = now_ns, False
        if peer is not None and keys is not None:
            self._log.say(f"packets are sealed with {peer.name}", "INFO")

    def _tell_refused(self, now_ns: int) -> None:
        refused = Counter(self.link.refused)
        if now_ns - self._changed_ns < _SETTLE_NS:
            # sealed for who has the lease, or for a run that is over
            self._told[Refusal.KEY] = refused[Refusal.KEY]
        new = refused - self._told
        if not new or (self._told_ns is not None and now_ns - self._told_ns < WARN_NS):
            return
        self._told, self._told_ns = refused, now_ns
        counts = ", ".join(f"{count} {reason.value}" for reason, count in sorted(new.items()))
        self._log.say(f"sealed packets refused: {counts}", "WARN")

    def _tell_silence(self, now_ns: int) -> None:
        """Say once what people would look for in vain: all is connected, and nothing comes."""
        peer = None if self._turned is None else self._peers.get(self._turned)
        quiet_ns = now_ns - max(self._changed_ns, self._opened_ns or 0)
        if peer is None or self._worried or quiet_ns < _SETTLE_NS:
            return
        if peer.heard_ns is None:
            if peer.name in self._node.partners():
                self._worried = True
                self._log.say(
                    f"{peer.name} is connected and offers no key: its network.packets_listen or "
                    "packets_connect may be missing",
                    "WARN",
                )
        elif now_ns - peer.heard_ns < UNHEARD_S * 1e9:
            self._worried = True
            self._log.say(
                f"nothing that {peer.name} has sealed arrives: is UDP let through to "
                "network.packets_listen?",
                "WARN",
            )


class SealedLinkKeeper(LinkKeeper):
    """Watches both of a site's nodes: by the channel, and by the offers."""

    def __init__(self, site: Site, sealing: SealKeeper, clock: Clock, log: DaemonLog) -> None:
        super().__init__(site, sealing, sealing, clock, log)
        self._sealing = sealing

    def _answered(self, now_ns: int) -> bool:
        answered = super()._answered(now_ns)
        return self._sealing.peer_heard() and (answered or self._sealing.waits)
