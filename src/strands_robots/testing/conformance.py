"""All promises, and a run of their checks on one robot."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace

from strands_robots.testing import bronze, gold, silver
from strands_robots.testing.bench import ConformanceBench
from strands_robots.testing.promise import Promise
from strands_robots.testing.report import GOOD, CheckMark, CheckResult, ConformanceReport, Tier
from strands_robots.testing.subject import Subject
from strands_robots.utils import ValidationError, near

MADE = Promise(
    "bronze.made",
    Tier.BRONZE,
    "It is made, and served on both networks.",
    "Whatever else it promises begins there.",
    "the callable that makes it, and its __init__",
    lambda bench: type(bench.body).__name__,
)


def promises(most: Tier = Tier.PLATINUM) -> tuple[Promise, ...]:
    """Return the promises of each tier up to ``most``, in their order."""
    return tuple(
        each for each in (MADE, *bronze.PROMISES, *silver.PROMISES, *gold.PROMISES) if each.tier.value <= most.value
    )


def conform(
    subject: Subject,
    most: Tier = Tier.PLATINUM,
    *,
    only: Iterable[str] = (),
    report: Callable[[CheckResult], None] = lambda result: None,
) -> ConformanceReport:
    """Check the promises of a robot on its emulated bus; it moves.

    Args:
        subject: makes the robot.
        most: the highest tier that is checked.
        only: names of checks; all by default.
        report: called with each result.

    Raises:
        ValidationError: a check or an exemption that does not exist.
    """
    chosen = promises(most)
    known = [each.name for each in promises()]
    wanted = frozenset(only)
    for name in (*wanted, *subject.exempt):
        if name not in known:
            raise ValidationError(f"there is no check {name}.{near(name, known)}")
    results: list[CheckResult] = []
    name = subject.name or "robot"
    try:
        with ConformanceBench(subject) as bench:
            name = subject.name or type(bench.body).__name__
            for each in chosen:
                if wanted and each.name not in wanted:
                    continue
                if any(result.check == each.needs and result.mark not in GOOD for result in results):
                    said = f"{each.needs} is not proven, without which it cannot be checked"
                    results.append(replace(each.result(CheckMark.NOT_PROVEN, said), waits_for=each.needs))
                    report(results[-1])
                    continue
                results.append(each.check(bench))
                report(results[-1])
                bench.rest()
    except Exception as exc:
        if results and not isinstance(exc, AssertionError):
            raise
        said = f"it could not be served: {type(exc).__name__}: {exc}"
        results.append(MADE.result(CheckMark.FAILED, said))
        report(results[-1])
    return ConformanceReport(name, tuple(results))
