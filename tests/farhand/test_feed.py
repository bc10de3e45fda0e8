"""Telemetry off the network: only this session's rows get through."""

import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import zenoh

from channel.zenoh_link import ZenohNode, ZenohSettings
from farhand.feed import Feed
from farhand.picture import picture_of
from site_runtime.certification import certify
from site_runtime.keys import SiteId, telemetry_key
from site_runtime.session import Session, load_session
from telemetry.dashboard.styles import STATE_COLOURS
from telemetry.stream import TelemetryStream
from tests.ports import free_port

EXPERIMENTS = Path(__file__).resolve().parents[2] / "experiments"
DEADLINE_S = 20.0


@pytest.fixture
def session() -> Session:
    return load_session(EXPERIMENTS / "demo.toml")


@pytest.fixture
def publish(session: Session) -> Iterator[tuple[str, Callable[[bytes], None]]]:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with closing(ZenohNode(ZenohSettings(listen=(endpoint,)))) as node:
        yield endpoint, node.publisher(telemetry_key(session.name, SiteId.LOCAL))


def batch_of(session: Session) -> bytes:
    published: list[bytes] = []
    stream = TelemetryStream(2, 2, SiteId.LOCAL, session.digest, 1, published.append)
    zeros = np.zeros(2)
    stream.put(
        stamp_ns=1, time_ns=1, lateness_ns=0, duration_ns=0, read_ns=0, step_ns=0, write_ns=0,
        sent_ns=0, requests=0, state=1, peer_state=255, cut=0,
        q=zeros, q_dot=zeros, torque_nm=zeros, position_m=zeros, velocity_m_s=zeros,
        external_force_n=zeros, coupling_force_n=zeros, peer_position_m=zeros,
        offset_m=zeros, force_share=0.0, engaged_s=0.0, used_stamp_ns=0, used_arrival_ns=0,
        clock_offset_ns=0, clock_uncertainty_ns=-1,
        one_way_delay_s=0.0, round_trip_s=0.0, loop_bound_s=0.0, certified_round_trip_s=0.3,
        sub_task_error_rad_s=0.0,
        lost=0, late=0, rejected=12 * [0], missed=0,
    )  # fmt: skip
    stream.drain()
    return published[0]


def test_own_rows_come_through_and_others_are_counted(
    session: Session, publish: tuple[str, Callable[[bytes], None]]
) -> None:
    endpoint, put = publish
    own, foreign = batch_of(session), batch_of(replace(session, digest=session.digest ^ 1))
    with closing(Feed(session, [endpoint])) as feed:
        received = []
        deadline = time.monotonic() + DEADLINE_S
        while not (received and feed.foreign and feed.broken):
            assert time.monotonic() < deadline, "the feed did not hear the publisher"
            for payload in (own, foreign, b"garbage"):
                put(payload)
            received += feed.receive()
    assert {batch.digest for batch, _ in received} == {session.digest}


def test_several_dashboards_hear_the_same(
    session: Session, publish: tuple[str, Callable[[bytes], None]]
) -> None:
    endpoint, put = publish
    with closing(Feed(session, [endpoint])) as first, closing(Feed(session, [endpoint])) as second:
        heard: tuple[list[object], ...] = ([], [])
        deadline = time.monotonic() + DEADLINE_S
        while not all(heard):
            assert time.monotonic() < deadline, "a feed did not hear the publisher"
            put(batch_of(session))
            for batches, feed in zip(heard, (first, second), strict=True):
                batches += feed.receive()


class Listed:
    """A Zenoh session that keeps a list of what it is asked to do."""

    def __init__(self, session: zenoh.Session, asked: list[str]) -> None:
        self._session = session
        self._asked = asked

    def __getattr__(self, name: str) -> object:
        self._asked.append(name)
        return getattr(self._session, name)


def test_it_can_only_read(
    session: Session,
    publish: tuple[str, Callable[[bytes], None]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    endpoint, put = publish
    asked: list[str] = []
    real_open = zenoh.open
    config = zenoh.Config()
    config.insert_json5("connect/endpoints", f'["{endpoint}"]')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("listen/endpoints", "[]")
    with real_open(config) as witness:
        everything = witness.declare_subscriber("**", zenoh.handlers.RingChannel(1000))
        tokens = witness.liveliness().declare_subscriber(
            "**", zenoh.handlers.RingChannel(100), history=True
        )
        monkeypatch.setattr(zenoh, "open", lambda settings: Listed(real_open(settings), asked))
        with closing(Feed(session, [endpoint])) as feed:
            received: list[object] = []
            deadline = time.monotonic() + DEADLINE_S
            while not received or everything.try_recv() is None:
                assert time.monotonic() < deadline, "the feed or the witness did not hear"
                put(batch_of(session))
                received += feed.receive()
                time.sleep(0.01)
        telemetry = telemetry_key(session.name, SiteId.LOCAL)
        while (sample := everything.try_recv()) is not None:
            assert str(sample.key_expr) == telemetry  # the site's own
        assert tokens.try_recv() is None
    assert asked == ["declare_subscriber", "declare_subscriber", "close"]


@pytest.mark.parametrize("name", ["demo", "seven_dof", "paper_free"])
def test_the_picture_shows_the_sessions_scene(name: str) -> None:
    session = load_session(EXPERIMENTS / f"{name}.toml")
    picture = picture_of(session)
    assert [view.name for view in picture.sites] == ["local", "remote"]
    assert len(picture.scene.obstacles) == len(session.remote.obstacles)
    assert len(picture.scene.walls) == len(session.remote.environment.walls)
    assert picture.spatial == (session.task.dimension == 3)
    for view in picture.sites:
        assert view.chain(np.zeros((3, view.joints))).shape == (3, view.joints + 1, 3)
        assert (view.urdf is not None) == (name == "seven_dof")
        if view.urdf is not None:
            assert view.urdf.path.is_file()
            assert view.urdf.joint_names == tuple(f"joint_{i}" for i in range(1, 8))
    assert set(picture.state_names.values()) == set(STATE_COLOURS)
    assert picture.certificate is not None
    assert picture.certificate.round_trip_s == certify(session).best.round_trip_s
    assert picture.meter is not None
    assert picture.meter() is not picture.meter()  # one a sink
