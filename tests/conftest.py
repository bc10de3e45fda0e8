"""What every test stands in."""

import signal
from collections.abc import Iterator

import pytest


def pytest_configure() -> None:
    """Take Ctrl-C back where a shell started the tests in the background, which ignores it.

    The daemons and commands that they start would inherit that.
    """
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(autouse=True, scope="session")
def state_home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Daemons that tests start record here, never in the user's own folder."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_STATE_HOME", str(tmp_path_factory.mktemp("state")))
        yield
