"""The session of the fault tests: the demo's arms in free motion, led by a restless hand."""

from pathlib import Path

import tomlkit

EXPERIMENTS = Path(__file__).parents[2] / "experiments"
NAME = "faults"
STIFFNESS_N_PER_M = 200.0
CEILING_N = 15.0
RAMP_S = 0.5
BLEND_S = 0.5
HOLD_AFTER_S = 0.1


def write_session(
    path: Path,
    *,
    lease_s: float,
    stiffness_n_per_m: float = STIFFNESS_N_PER_M,
    router: str | None = None,
    operator: dict[str, object] | None = None,
    profile: str | None = None,
    channel: dict[str, object] | None = None,
    network: dict[str, object] | None = None,
) -> Path:
    """Write the session file of one site and return its path; endpoints come by command line.

    A `profile` gives the lease too.
    """
    document = tomlkit.parse((EXPERIMENTS / "demo.toml").read_text(encoding="utf-8")).unwrap()
    document["name"] = NAME
    document["channel"] = {"injection": "off"} | (channel or {})
    document["engagement"] = {
        "ramp_s": RAMP_S,
        "hold_after_s": HOLD_AFTER_S,
        "blend_s": BLEND_S,
    }
    document["coupling"]["stiffness_n_per_m"] = [stiffness_n_per_m] * 2
    document["coupling"]["force_ceiling_n"] = [CEILING_N] * 2
    if operator is not None:
        document["local"]["operator"] = operator
    if profile is None:
        document["network"]["lease_s"] = lease_s
    else:
        document["network"]["profile"] = profile
    document["network"]["allow_plaintext"] = True  # namespaces of our own
    document["network"] |= network or {}
    if router is not None:
        document["network"]["router"] = router
    for contact in ("environment", "obstacles", "null_space", "sub_tasks"):
        del document["remote"][contact]
    path.write_text(tomlkit.dumps(document), encoding="utf-8")
    return path


def pulses(count: int, every_s: float = 10.0, push_s: float = 2.0) -> dict[str, object]:
    """Return a hand that pushes now and then, to and fro along both axes, and lets go between."""
    pushes = [("x", -6.0), ("y", 6.0), ("x", 6.0), ("y", -6.0)]
    return {
        "kind": "pulses",
        "pulses": [
            {
                "axis": pushes[number % 4][0],
                "force_n": pushes[number % 4][1],
                "start_s": 2.0 + number * every_s,
                "end_s": 2.0 + number * every_s + push_s,
            }
            for number in range(count)
        ],
    }
