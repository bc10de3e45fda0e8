"""What is told of a peer's other session, by its digest."""

from pathlib import Path

import pytest

from site_runtime.other_session import OtherSession, profile_digests
from site_runtime.session import Session, load_session, parse_session
from site_runtime.session_edit import edited

DEMO = Path(__file__).parents[2] / "experiments" / "demo.toml"


def demo(**changes: str | int) -> Session:
    dotted = {name.replace("__", "."): value for name, value in changes.items()}
    return parse_session(edited(DEMO.read_text(encoding="utf-8"), dotted), DEMO)


@pytest.mark.parametrize(
    ("here", "there", "told"),
    [
        ("wan", "lan", 'network.profile = "lan" or "wifi", here it is "wan"'),
        ("wifi", "lossy", 'network.profile = "wan" or "lossy", here it is "wifi"'),
    ],
)
def test_a_profile_that_explains_it_is_named(here: str, there: str, told: str) -> None:
    heard = demo(network__profile=there).digest
    other = OtherSession(demo(network__profile=here), lambda: heard)
    assert told in str(other.trouble)
    assert other.told == other.trouble


def test_what_no_profile_explains_names_none() -> None:
    heard = demo(network__profile="wan", loop__rate_hz=500).digest
    other = OtherSession(demo(network__profile="wan"), lambda: heard)
    assert "ANOTHER session file" in str(other.trouble)
    assert "here it is" not in str(other.trouble)


def test_what_was_told_stays_for_the_summary() -> None:
    heard: list[int | None] = [5, None]
    other = OtherSession(load_session(DEMO), lambda: heard.pop(0))
    told = other.trouble
    assert other.trouble is None
    assert other.told == told is not None


def test_values_in_the_file_make_profiles_the_same() -> None:
    digests = profile_digests(demo(channel__send_rate_hz=250, channel__adapt_send_rate=True))
    assert len(set(digests.values())) == 1
