"""Profiles of networks: what they say holds where the file says nothing."""

from dataclasses import replace
from pathlib import Path

import pytest

from site_runtime.certification import certified_round_trip_s, certify, slowest_send_period_ns
from site_runtime.network_profiles import PROFILES, fitting
from site_runtime.session import Session, SessionFileError, parse_session

DEMO = Path(__file__).parents[2] / "experiments" / "demo.toml"


def session(
    profile: str | None, network: str = "", channel: str = "", loop_hz: int = 1000
) -> Session:
    text = DEMO.read_text(encoding="utf-8").replace("rate_hz = 1000", f"rate_hz = {loop_hz}")
    chosen = "" if profile is None else f'profile = "{profile}"\n'
    text = text.replace("[network]\n", f"[network]\n{chosen}{network}\n")
    text = text.replace('injection = "exact"\n', f'injection = "exact"\n{channel}\n')
    return parse_session(text, DEMO)


@pytest.mark.parametrize("name", PROFILES)
def test_a_profile_s_values_hold_where_the_file_has_none(name: str) -> None:
    profile, loaded = PROFILES[name], session(name)
    assert loaded.network.lease_s == profile.lease_s
    assert loaded.network.open_timeout_s == profile.open_timeout_s
    assert loaded.channel.send_rate_hz == profile.most_send_hz
    assert loaded.channel.adapt_send_rate is profile.adapt_send_rate


def test_without_a_word_it_is_a_lan_but_for_handshakes_which_may_cross_a_wan() -> None:
    lan = session("lan").network
    assert session(None).network == replace(lan, open_timeout_s=PROFILES["wan"].open_timeout_s)
    assert session(None).digest == session("lan").digest == session("wifi").digest
    assert session("wan").digest != session("lan").digest, "the send rate is agreed"


def test_the_file_s_own_values_win() -> None:
    loaded = session(
        "wan", "lease_s = 3.0\nopen_timeout_s = 5.0", "send_rate_hz = 500\nadapt_send_rate = false"
    )
    assert (loaded.network.lease_s, loaded.network.open_timeout_s) == (3.0, 5.0)
    assert loaded.channel.send_rate_hz == 500
    assert not loaded.channel.adapt_send_rate


def test_the_send_rate_is_the_greatest_that_the_loop_can_have() -> None:
    assert session("wan", loop_hz=800).channel.send_rate_hz == 200
    assert session("wan", loop_hz=100).channel.send_rate_hz == 100


def test_an_unknown_profile_is_told_with_the_others() -> None:
    with pytest.raises(SessionFileError, match=r"network\.profile"):
        session("satellite", "lease_s = -1.0")


def test_the_first_profile_that_a_network_is_within_fits() -> None:
    assert fitting(0.001, 0.001, 0.0) == "lan"
    assert fitting(0.008, 0.02, 0.01) == "wifi"
    assert fitting(0.1, 0.01, 0.001) == "wan"
    assert fitting(0.1, 0.04, 0.02) == "lossy"
    assert fitting(0.5, 0.0, 0.0) == "lossy"
    assert fitting(float("nan"), 0.0, 0.0) == "lossy"


def test_adapting_leaves_most_of_the_certificate_to_the_network() -> None:
    plain, adapting = session(None), session(None, channel="adapt_send_rate = true")
    assert slowest_send_period_ns(plain) == plain.send_period_ns
    slowest_ns = slowest_send_period_ns(adapting)
    assert slowest_ns == 33_000_000, "a third of hold_after_s = 0.1"
    patient = replace(adapting, engagement=replace(adapting.engagement, hold_after_s=1.0))
    certified_s = certified_round_trip_s(patient)
    assert 2e-9 * slowest_send_period_ns(patient) <= certified_s / 4
    assert slowest_send_period_ns(patient) == 37_000_000
    # what is injected counts the spacing at its slowest
    grown_s = 2e-9 * (slowest_ns - adapting.send_period_ns)
    assert certify(adapting).injected_round_trip_s == pytest.approx(
        certify(plain).injected_round_trip_s + grown_s
    )
