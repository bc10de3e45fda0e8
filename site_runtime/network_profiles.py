"""What to expect of a network, and the settings that fit; docs/networks.md has the reasons."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Final, Literal, TypeAlias

ProfileName: TypeAlias = Literal["lan", "wifi", "wan", "lossy"]


@dataclass(frozen=True, slots=True)
class NetworkProfile:
    """Settings for one kind of network; `most_send_hz` None is every tick.

    `loss_tolerant` asks for endpoints that do not repeat what is lost. It fits up to a round trip's
    p99 − p50 of `jitter_s`, to a share `lost` of packets, and to a median round trip.
    """

    lease_s: float
    open_timeout_s: float
    most_send_hz: int | None
    adapt_send_rate: bool
    loss_tolerant: bool
    round_trip_s: float
    jitter_s: float
    lost: float


PROFILES: Final[Mapping[str, NetworkProfile]] = MappingProxyType(
    {
        "lan": NetworkProfile(0.5, 1.0, None, False, False, 0.01, 0.005, 0.0005),
        "wifi": NetworkProfile(1.0, 1.0, None, False, True, 0.03, 0.03, 0.02),
        "wan": NetworkProfile(1.0, 2.0, 250, True, False, 0.3, 0.03, 0.003),
        "lossy": NetworkProfile(
            1.5, 1.0, 250, True, True, float("inf"), float("inf"), float("inf")
        ),
    }
)


def fill(document: dict[str, Any]) -> None:
    """Put a profile's values where a session file's tables give none of their own.

    What is wrong with the file is left to its validation.
    """
    network, channel = document.get("network"), document.get("channel", {})
    if not isinstance(network, dict) or not isinstance(channel, dict):
        return
    name = network.get("profile")
    if not isinstance(name, str) or name not in PROFILES:
        return
    profile = PROFILES[name]
    network.setdefault("lease_s", profile.lease_s)
    network.setdefault("open_timeout_s", profile.open_timeout_s)
    channel.setdefault("adapt_send_rate", profile.adapt_send_rate)
    loop = document.get("loop", {})
    rate_hz = loop.get("rate_hz", 1000) if isinstance(loop, dict) else None
    if profile.most_send_hz is not None and isinstance(rate_hz, int) and rate_hz > 0:
        divisors = (hz for hz in range(1, profile.most_send_hz + 1) if rate_hz % hz == 0)
        channel.setdefault("send_rate_hz", max(divisors))
    document["channel"] = channel


def fitting(round_trip_s: float, jitter_s: float, lost: float) -> ProfileName:
    """Return the first profile that a measured network is within: round trip p50, p99 − p50."""
    names: tuple[ProfileName, ...] = ("lan", "wifi", "wan")
    for name in names:
        profile = PROFILES[name]
        within = round_trip_s <= profile.round_trip_s and jitter_s <= profile.jitter_s
        if within and lost <= profile.lost:
            return name
    return "lossy"
