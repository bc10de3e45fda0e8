"""A process that hears both sites' telemetry and keeps it in a file, and that file's reader.

It listens and the sites connect to it, so a new run is heard from its first rows on (a
`farhand.feed.Feed` dials, and may come a second late); with certificates it dials, as an observer's
are good for nothing else. It ends with its standard input.
"""

import select
import struct
import sys
from contextlib import closing
from pathlib import Path

import numpy as np

from channel.zenoh_link import ZenohNode, ZenohSettings
from farhand.feed import DASHBOARD
from site_runtime.keys import SiteId, telemetry_key
from site_runtime.security.identity import Identity
from site_runtime.security.network import meet_as_observer
from site_runtime.session import load_session
from telemetry.rows import RowArray
from telemetry.stream import decode_batch

POLL_S = 0.005
LEASE_MS = 30_000  # longer than any suspension: what follows one is heard too
_LENGTH = struct.Struct("<I")


class Recording:
    """What an observer has written so far: the rows of each run of each site."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._read = 0
        self._runs: dict[SiteId, dict[int, list[RowArray]]] = {site: {} for site in SiteId}

    def runs(self, site: SiteId) -> list[int]:
        """Epochs of the site's runs, in the order in which they were first heard."""
        self._update()
        return list(self._runs[site])

    def rows(self, site: SiteId, epoch: int, since_ns: int = 0) -> RowArray:
        """Rows of one run stamped at or after `since_ns`; at least one batch of it was heard."""
        self._update()
        batches = self._runs[site][epoch]
        # only the batches that end late enough: the file grows by 2000 rows a second
        first = len(batches)
        while first > 0 and batches[first - 1]["stamp_ns"][-1] >= since_ns:
            first -= 1
        rows = np.concatenate(batches[first:]) if first < len(batches) else batches[-1][:0]
        return rows[rows["stamp_ns"] >= since_ns]

    def _update(self) -> None:
        if not self._path.exists():
            return
        with self._path.open("rb") as file:
            file.seek(self._read)
            data = file.read()
        place = 0
        while place + _LENGTH.size <= len(data):
            end = place + _LENGTH.size + _LENGTH.unpack_from(data, place)[0]
            if end > len(data):
                break
            batch = decode_batch(data[place + _LENGTH.size : end])
            self._runs[SiteId(batch.site)].setdefault(batch.epoch, []).append(batch.rows)
            place = end
        self._read += place


def observe(settings: ZenohSettings, name: str, path: Path) -> None:
    """Write all telemetry of session `name` to `path` until standard input ends."""
    with (
        closing(ZenohNode(settings)) as node,
        path.open("wb") as file,
    ):
        subscriptions = [node.subscriber(telemetry_key(name, site), 4096) for site in SiteId]
        sys.stdout.write("ready\n")
        sys.stdout.flush()
        while not select.select([sys.stdin], [], [], POLL_S)[0]:
            for subscription in subscriptions:
                for _, payload in subscription.receive():
                    file.write(_LENGTH.pack(len(payload)) + payload)
            file.flush()


def main(endpoint: str, name: str, path: str, session: str | None = None) -> None:
    """Listen at an endpoint, or, with a session whose parties have certificates, dial it."""
    settings = ZenohSettings(listen=(endpoint,), lease_ms=LEASE_MS)
    if session is not None:
        observer = Identity(DASHBOARD)
        settings = meet_as_observer(load_session(session), observer, [endpoint]).settings
    observe(settings, name, Path(path))


if __name__ == "__main__":
    main(*sys.argv[1:])
