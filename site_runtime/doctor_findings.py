"""What an examination of this machine finds."""

from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum


class Verdict(Enum):
    """How something is, for a loop at the session's rate."""

    GOOD = "good"
    WILL_DO = "will do"
    NOT_GOOD = "not good"
    NOT_MEASURED = "not measured"


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing looked at: what was seen, and what to change, with the command or the file.

    `decisive` ones alone decide whether the machine holds the rate: they are what was measured of
    the loop itself. All others tell why, or concern something else.
    """

    what: str
    verdict: Verdict
    measured: str
    change: str = ""
    decisive: bool = False


def holds_the_rate(findings: Iterable[Finding]) -> bool:
    """Whether all that is decisive was measured, and is good or will do."""
    enough = (Verdict.GOOD, Verdict.WILL_DO)
    return all(found.verdict in enough for found in findings if found.decisive)
