"""Sees to it that a link that carries one way only is opened anew."""

import threading
from collections.abc import Callable
from types import TracebackType
from typing import Final, Self

from channel.channel import Channel
from site_runtime.clock import Clock

UNHEARD_S: Final = 3.0
"""So long must the peer be heard, and not hear: longer than any round trip of a usable network."""

FRESH_S: Final = 1.0


class LinkKeeper:
    """Watches one site's channel from a thread of its own, in a `with` statement.

    `reopen` opens the link anew and may take its time. A peer that obeys another site is no reason.
    """

    def __init__(self, channel: Channel, reopen: Callable[[], None], clock: Clock) -> None:
        self._channel = channel
        self._reopen = reopen
        self._clock = clock
        self._well_ns = clock.now_ns()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="link", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._ended.set()
        self._thread.join(timeout=1.0)

    def look(self) -> None:
        """Open the link anew if the peer has not heard this site for so long, though it speaks."""
        now_ns = self._clock.now_ns()
        if not self._one_way(now_ns):
            self._well_ns = now_ns
        elif now_ns - self._well_ns >= UNHEARD_S * 1e9:
            self._reopen()
            self._well_ns = self._clock.now_ns()

    def _one_way(self, now_ns: int) -> bool:
        channel, fresh_ns = self._channel, FRESH_S * 1e9
        heard_ns, echoed_ns = channel.heard_ns, channel.echoed_ns
        if heard_ns is None or now_ns - heard_ns > fresh_ns or channel.peer_taken:
            return False
        return echoed_ns is None or now_ns - echoed_ns > fresh_ns

    def _watch(self) -> None:
        while not self._ended.wait(FRESH_S / 2):
            self.look()
