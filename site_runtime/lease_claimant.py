"""An operator's side of the lease: claims the remote robot for as long as the local site runs."""

import time
from collections.abc import Callable
from typing import Final

from site_runtime.daemon_log import DaemonLog
from site_runtime.keeper import Keeper
from site_runtime.lease import Verb, Wish
from site_runtime.lease_keeper import Ear
from site_runtime.lease_messages import RemoteStatus, decode_status, encode_wish
from site_runtime.site import Site

CLAIM_S: Final = 0.25
_SILENT_S: Final = 4.0
_FAREWELLS: Final = 3


class LeaseClaimant(Keeper):
    """Claims in one operator's name, from a thread of its own, in a `with` statement.

    Who holds the robot instead is its trouble, for the status line, and an event. The site stays
    undriven until the remote has said that this operator holds it, and again as soon as it says
    otherwise.
    """

    def __init__(
        self,
        person: str,
        epoch: int,
        site: Site,
        ear: Ear,
        publish: Callable[[bytes], None],
        log: DaemonLog,
    ) -> None:
        super().__init__("lease", CLAIM_S, log)
        self._person = person
        self._epoch = epoch
        self._site = site
        self._ear = ear
        self._publish = publish
        self._holds = False
        self._heard_s = time.monotonic()
        self._trouble: str | None = None
        self._told = ""
        site.requests.unleased = True

    def ended(self) -> None:
        """Give the lease back."""
        release = encode_wish(Wish(Verb.RELEASE, time.time_ns()))
        for _ in range(_FAREWELLS):  # a lost one costs the next operator the time of expiry
            self._publish(release)
            time.sleep(0.02)

    @property
    def trouble(self) -> str | None:
        """Why this operator does not have the robot, None if he has."""
        return self._trouble

    @property
    def holds(self) -> bool:
        """Whether the remote has said last that this operator has the robot."""
        return self._holds

    def look(self) -> None:
        """Claim, and take in the newest of what the remote says."""
        self._publish(encode_wish(Wish(Verb.CLAIM, self._epoch)))
        told = [status for _, data in self._ear.receive() if (status := decode_status(data))]
        if told:
            self._heard_s = time.monotonic()
            self._holds = told[-1].holder == self._person
            self._site.requests.unleased = not self._holds
            self._tell(self._trouble_in(told[-1]))
        elif time.monotonic() - self._heard_s > _SILENT_S:
            self._tell("lease: the remote site tells nothing of it")

    def look_failed(self) -> None:
        """Drive no more until the remote is heard to say that this operator may."""
        self._holds = False
        self._site.requests.unleased = True
        self._tell("lease: not known, as looking at it failed")

    def _trouble_in(self, status: RemoteStatus) -> str | None:
        if self._holds:
            return None
        reason = status.refused.get(self._person)
        return "lease: not held" if reason is None else f"lease: refused, {reason}"

    def _tell(self, trouble: str | None) -> None:
        text = trouble or f"lease: {self._person} holds the remote robot"
        if text != self._told:
            self._site.notices.append(text)
        self._trouble, self._told = trouble, text
