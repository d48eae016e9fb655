"""Results of the checks of a robot, in words and as JSON."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from enum import Enum, StrEnum
from typing import Any


class Tier(Enum):
    """Tier of a robot; each includes those below it."""

    BRONZE = 1
    SILVER = 2
    GOLD = 3
    PLATINUM = 4

    @property
    def label(self) -> str:
        """Return its name in lower case."""
        return self.name.lower()


class CheckMark(StrEnum):
    """Result of one check."""

    PASSED = "passed"
    FAILED = "failed"
    DRIFT = "drift"
    """The robot does something other than what it declares."""

    NOT_PROVEN = "not proven"
    EXEMPT = "exempt"
    STALE = "stale exemption"
    """The promise is kept, so its exemption has to go."""


GOOD = frozenset({CheckMark.PASSED, CheckMark.EXEMPT})
BAD = frozenset({CheckMark.FAILED, CheckMark.DRIFT, CheckMark.STALE})


@dataclass(frozen=True, slots=True)
class CheckResult:
    """Result of a check, with the promise and where to look when it is not kept."""

    check: str
    tier: Tier
    mark: CheckMark
    said: str
    promise: str
    why: str
    look: str
    seconds: float = 0.0
    waits_for: str = ""
    """The check without which this one cannot be made."""

    def words(self, *others: str) -> str:
        """Return it for a person, with the names of ``others`` of which it says the same.

        One that is not kept comes with its promise, why it matters and where to look.
        """
        lines = [f"{self.mark.upper()} {', '.join((self.check, *others))}: {self.said}"]
        if self.mark in BAD:
            lines += [f"  promise: {self.promise}", f"  matters: {self.why}", f"  look at: {self.look}"]
        return "\n".join(lines)


@dataclass(frozen=True, slots=True)
class ConformanceReport:
    """Results of the checks of one robot.

    Args:
        whole: every promise was checked, and not only chosen ones, which are no tier.
    """

    name: str
    results: Sequence[CheckResult]
    whole: bool = True

    @property
    def tier(self) -> Tier | None:
        """The highest tier up to which every promise is kept; None for none."""
        reached = None
        if not self.whole:
            return None
        for tier in Tier:
            marks = [each.mark for each in self.results if each.tier is tier]
            if not marks or not GOOD.issuperset(marks):
                break
            reached = tier
        return reached

    @property
    def failed(self) -> list[CheckResult]:
        """Results that a test has to fail for; what is not proven is none of them."""
        return [each for each in self.results if each.mark in BAD]

    def words(self) -> str:
        """Return the report for a person: the tier, each promise not kept, the way on."""
        tier = self.tier
        none = "no tier" if self.whole else "no tier, for not every check was made"
        lines = [f"{self.name}: {none if tier is None else tier.label}"]
        for each in Tier:
            marks = [result.mark for result in self.results if result.tier is each]
            if marks:
                counts = ", ".join(f"{marks.count(mark)} {mark}" for mark in CheckMark if mark in marks)
                lines.append(f"  {each.label}: {counts}")
        lines += [first.words(*(each.check for each in others)) for first, *others in self._alike()]
        return "\n".join([*lines, *self._way_on(tier)])

    def _alike(self) -> list[list[CheckResult]]:
        """Return what a person has to read; one line for one reason."""
        groups: dict[tuple[str, ...], list[CheckResult]] = {}
        for result in self.results:
            if result.mark is CheckMark.PASSED or result.waits_for:
                continue
            together = result.mark is CheckMark.NOT_PROVEN
            groups.setdefault((result.said,) if together else (result.said, result.check), []).append(result)
        return list(groups.values())

    def _way_on(self, tier: Tier | None) -> list[str]:
        """Return what the next tier needs, and what waits for that."""
        lacking = [each for each in self.results if each.mark not in GOOD]
        if not lacking:
            return []
        up = min(each.tier.value for each in lacking)
        first = ", ".join(each.check for each in lacking if each.tier.value == up and not each.waits_for)
        waiting = [each.check for each in lacking if each.waits_for]
        lines = [f"To {Tier(up).label}: {first}."] if first else []
        return [*lines, *([f"Waiting for that: {', '.join(waiting)}."] if waiting else [])]

    def facts(self) -> dict[str, Any]:
        """Return the report as JSON can carry it."""
        tier = self.tier
        rows = [{**asdict(each), "tier": each.tier.label, "mark": each.mark.value} for each in self.results]
        return {
            "robot": self.name,
            "tier": None if tier is None else tier.label,
            "failed": len(self.failed),
            "checks": rows,
        }
