"""A connection that carries nothing is opened anew; behind a router, an absent peer is awaited."""

import time
from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path

import pytest

from channel.zenoh_link import ZenohNode, ZenohSettings
from site_runtime.keys import lease_key
from site_runtime.lease_messages import decode_status
from site_runtime.link_keeper import ASK_S, UNHEARD_S
from tests.loopback.deaf_wire import DeafWire
from tests.loopback.secured import NAME, until, write_session
from tests.ports import free_port
from tests.running import running

pytestmark = pytest.mark.patient
ABSENT_S = 2.5 * (UNHEARD_S + ASK_S)


class Wired:
    """A local site with a wire to the remote one, or to a router that the remote one dials too."""

    def __init__(self, folder: Path, *, routed: bool) -> None:
        port = free_port()
        self.wire = DeafWire(port)
        self.files = {}
        for name, at in (("router", port), ("remote", port), ("local", self.wire.port)):
            network: dict[str, object] = {"router": f"tcp/127.0.0.1:{at}"}
            if not routed:
                network = {
                    "remote_listen": f"tcp/127.0.0.1:{port}",
                    "local_connect": f"tcp/127.0.0.1:{at}",
                    "local_listen": f"tcp/127.0.0.1:{free_port()}",
                }
            # a lease that outlasts a busy machine: no connection is to end by itself
            self.files[name] = write_session(
                folder / f"{name}.toml", folder, security="none", **network | {"lease_s": 10.0}
            )
        self._stack = ExitStack()
        self._node = ZenohNode(
            ZenohSettings(
                connect=(f"tcp/127.0.0.1:{port}",),
                configuration={"region_name": "observer"} if routed else {},
            )
        )
        self._ear = self._node.subscriber(lease_key(NAME), 100)
        self.said = folder / "local.log"

    def run(self, name: str) -> ExitStack:
        """Start one, until the stack is closed."""
        command = ("farhand", "router") if name == "router" else (f"{name}_site",)
        options = () if name == "router" else ("--no-record",)
        log = self.said if name == "local" else None
        stack = self._stack.enter_context(ExitStack())
        stack.enter_context(running(*command, str(self.files[name]), *options, log=log))
        return stack

    def until_engaged(self) -> None:
        """By what the remote site tells from now on."""
        self._ear.receive()

        def engaged() -> bool:
            told = [decode_status(payload) for _, payload in self._ear.receive()]
            return bool(told) and told[-1] is not None and told[-1].state == "ENGAGED"

        until(engaged, "the remote site ENGAGED")

    def opened_anew(self) -> int:
        return self.said.read_text(encoding="utf-8").count("the connection is opened anew")

    def close(self) -> None:
        self._stack.close()
        self._node.close()
        self.wire.close()


@pytest.fixture
def routed(tmp_path: Path) -> Iterator[Wired]:
    with closing(Wired(tmp_path, routed=True)) as wired:
        wired.run("router")
        yield wired


@pytest.fixture
def direct(tmp_path: Path) -> Iterator[Wired]:
    with closing(Wired(tmp_path, routed=False)) as wired:
        yield wired


def test_an_absent_peer_is_waited_for_on_the_same_connection(routed: Wired) -> None:
    routed.run("local")
    until(lambda: routed.wire.connections == 1, "a connection")
    time.sleep(ABSENT_S)
    with routed.run("remote"):
        routed.until_engaged()
    time.sleep(ABSENT_S)
    routed.run("remote")
    routed.until_engaged()
    assert (routed.wire.connections, routed.opened_anew()) == (1, 0), routed.said.read_text()


@pytest.mark.parametrize("place", ["routed", "direct"])
@pytest.mark.parametrize("inwards", [True, False], ids=["hears nothing", "is not heard"])
def test_a_connection_that_carries_nothing_is_opened_anew(
    place: str, inwards: bool, request: pytest.FixtureRequest
) -> None:
    wired: Wired = request.getfixturevalue(place)
    wired.run("remote")
    wired.run("local")
    wired.until_engaged()
    assert wired.wire.connections == 1
    wired.wire.cut(inwards=inwards)
    until(lambda: wired.wire.connections == 2, "a second connection", within_s=30.0)
    wired.until_engaged()
    assert wired.opened_anew() == 1


def test_so_it_is_while_the_peer_is_absent(routed: Wired) -> None:
    """Nobody can say then whether it is: the router does not answer."""
    routed.run("local")
    until(lambda: routed.wire.connections == 1, "a connection")
    time.sleep(1.0)
    routed.wire.cut(inwards=True)
    until(lambda: routed.wire.connections == 2, "a second connection", within_s=30.0)
    routed.run("remote")
    routed.until_engaged()
