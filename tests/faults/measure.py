"""How long the sites take to be safe after each fault, as a Markdown table.

python -m tests.faults.measure [--repeats 20] [--only NAME]
"""

import argparse
import re
import statistics
import sys
import tempfile
from pathlib import Path

from tests.faults import namespace, wall_clock
from tests.faults.scenarios import SCENARIOS
from tests.faults.sites import BOTH
from tests.faults.stage import Outcome, Scenario, Setting, opened

HEAD = (
    "| fault | local | remote | time to safe state, median, worst [ms] "
    "| longest loop while ENGAGED [ms] | beyond the certified loop [s] | as expected | test |\n"
    "|---|---|---|---|---|---|---|---|"
)


def measure(scenarios: list[Scenario], repeats: int) -> dict[str, list[Outcome]]:
    """Play scenarios so often, with fresh daemons each time; what is wrong goes to stderr."""
    outcomes: dict[str, list[Outcome]] = {scenario.name: [] for scenario in scenarios}
    for repeat in range(repeats):
        for setting in Setting:
            playing = [scenario for scenario in scenarios if scenario.setting is setting]
            if not playing:
                continue
            with (
                tempfile.TemporaryDirectory(prefix="farhand-faults-") as folder,
                opened(setting, Path(folder), seed=repeat + 1) as stage,
            ):
                for scenario in playing:
                    outcome = stage.play(scenario)
                    outcomes[scenario.name].append(outcome)
                    for wrong in (*outcome.violations, *outcome.deviations):
                        sys.stderr.write(f"{repeat + 1}: {scenario.name}: {wrong}\n")
    return outcomes


def row(outcomes: list[Outcome]) -> str:
    """One line of the table: states as most often seen, times over all repeats and sites."""
    scenario = outcomes[0].scenario
    states = [_brief(statistics.mode(o.states.get(site, "") for o in outcomes)) for site in BOTH]
    times_ms = [1e3 * time_s for outcome in outcomes for time_s in outcome.safe_s.values()]
    times = f"{statistics.median(times_ms):.0f}, {max(times_ms):.0f}" if times_ms else "–"
    fit = sum(not (outcome.violations or outcome.deviations) for outcome in outcomes)
    notes = sorted({note for outcome in outcomes for note in outcome.notes})
    name = scenario.name + "".join(f"; {note}" for note in notes[:1])
    cells = (
        name,
        *states,
        times,
        f"{1e3 * max(o.longest_s for o in outcomes):.0f}",
        f"{max(o.beyond_s for o in outcomes):.2f}",
        f"{fit} of {len(outcomes)}",
        f"test_scenarios.py[{scenario.name}]",
    )
    return "| " + " | ".join(cells) + " |"


def _brief(states: str) -> str:
    """Fold repeated returns to HOLD."""
    turns = states.count(" HOLD ENGAGED")
    if turns > 1:
        return re.sub(r"( HOLD ENGAGED)+", f", {turns} times HOLD ENGAGED", states, count=1)
    return states or "not running"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--only", action="append", help="a scenario's name; repeatable")
    options = parser.parse_args()
    chosen = [s for s in SCENARIOS if options.only is None or s.name in options.only]
    if not chosen:
        parser.error("no such scenario; there are: " + ", ".join(s.name for s in SCENARIOS))
    if namespace.refusal() is not None:
        sys.stderr.write(f"left out: what needs an impaired network ({namespace.refusal()})\n")
        chosen = [s for s in chosen if s.setting is not Setting.NETWORK]
    if wall_clock.COMPILER is None:
        sys.stderr.write("left out: wall clocks, as there is no C compiler `cc`\n")
        chosen = [s for s in chosen if "wall clock" not in s.name]
    outcomes = measure(chosen, options.repeats)
    sys.stdout.write("\n".join([HEAD, *(row(seen) for seen in outcomes.values() if seen)]) + "\n")


if __name__ == "__main__":
    main()
