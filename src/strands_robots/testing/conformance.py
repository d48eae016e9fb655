"""All promises, and a run of their checks on one robot."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace

from strands_robots.fleet.networks import Networks
from strands_robots.testing import bronze, gold, platinum, silver
from strands_robots.testing.bench import ConformanceBench, NotProvenError
from strands_robots.testing.live import LiveBench, check_live
from strands_robots.testing.promise import Promise
from strands_robots.testing.report import GOOD, CheckMark, CheckResult, ConformanceReport, Tier
from strands_robots.testing.subject import LongMotion, Subject
from strands_robots.utils import ValidationError, near


def _made(bench: ConformanceBench) -> str:
    """Make it, and find it on each network."""
    return type(bench.body).__name__


MADE = Promise(
    "bronze.made",
    Tier.BRONZE,
    "It is made, and served on both networks.",
    "Whatever else it promises begins there.",
    "the callable that makes it, and its __init__",
    _made,
)


def promises(most: Tier = Tier.PLATINUM) -> tuple[Promise, ...]:
    """Return the promises of each tier up to ``most``, in their order."""
    every = (MADE, *bronze.PROMISES, *silver.PROMISES, *gold.PROMISES, *platinum.PROMISES)
    return tuple(each for each in every if each.tier.value <= most.value)


def conform(
    subject: Subject,
    most: Tier = Tier.GOLD,
    *,
    only: Iterable[str] = (),
    report: Callable[[CheckResult], None] = lambda result: None,
    checking: Callable[[str], None] = lambda check: None,
    hardware: bool = False,
) -> ConformanceReport:
    """Check the promises of a robot on its emulated bus; it moves.

    Args:
        subject: makes the robot.
        most: the highest tier that is checked. That of platinum is a load of some seconds, for a robot that is gold.
        only: names of checks; all by default.
        report: called with each result.
        checking: called with the name of each check before it begins.
        hardware: it moves metal, so that only its motion is called, which its operator has approved.

    Raises:
        ValidationError: a check or an exemption that does not exist.
    """
    chosen = chosen_of(most, only, subject)
    results: list[CheckResult] = []

    def tell(result: CheckResult) -> None:
        results.append(result)
        report(result)

    name = subject.name or "robot"
    try:
        checking(MADE.name)
        with ConformanceBench(subject) as bench:
            name = subject.name or type(bench.body).__name__
            if hardware:
                _check_each(chosen, lambda each: check_live(each, bench), tell, checking, waits=False)
            else:
                _check_each(chosen, lambda each: each.check(bench), tell, checking, then=bench.rest)
    except Exception as exc:
        if results and not isinstance(exc, AssertionError):
            raise
        tell(unserved(exc))
    return ConformanceReport(name, tuple(results), whole=len(chosen) == len(promises(most)))


def conform_live(
    networks: Networks,
    robot: str,
    most: Tier = Tier.GOLD,
    *,
    motion: LongMotion | None = None,
    only: Iterable[str] = (),
    report: Callable[[CheckResult], None] = lambda result: None,
) -> ConformanceReport:
    """Check the promises of a robot that another process serves, as far as may be.

    Without a motion nothing moves it. With one, what the network says of its stops is told; no stop is proven.

    Args:
        networks: joined.
        robot: its id.
        motion: one that its operator has approved; it is started several times and stopped.
        most: as of :func:`conform`, and so are the others.

    Raises:
        RefusalError: no network has it; or with a motion, two robots have the id.
        ValidationError: a check that does not exist.
    """
    subject = Subject(_made_elsewhere, name=robot, motion=motion)
    chosen = chosen_of(most, only, subject)
    results: list[CheckResult] = []

    def tell(result: CheckResult) -> None:
        results.append(result)
        report(result)

    bench = LiveBench(networks, robot, subject)
    _check_each(chosen, lambda each: check_live(each, bench), tell, waits=False)
    return ConformanceReport(robot, tuple(results), whole=len(chosen) == len(promises(most)))


def _made_elsewhere() -> object:
    raise NotProvenError("another process makes it")


def chosen_of(most: Tier, only: Iterable[str], subject: Subject) -> list[Promise]:
    """Return the promises up to a tier; those named in ``only``, or all.

    Raises:
        ValidationError: a check or an exemption of the subject that does not exist.
    """
    known = [each.name for each in promises()]
    wanted = frozenset(only)
    for name in (*wanted, *subject.exempt):
        if name not in known:
            raise ValidationError(f"there is no check {name}.{near(name, known)}")
    return [each for each in promises(most) if not wanted or each.name in wanted]


class PromiseChecks:
    """Checks of one robot, one after another.

    Args:
        check: checks a promise.
        waits: leave out one without whose need it cannot be checked.
    """

    def __init__(self, check: Callable[[Promise], CheckResult], *, waits: bool = True) -> None:
        self._check, self._waits = check, waits
        self._lacking: dict[str, Tier] = {}

    def blocked(self, promise: Promise) -> str:
        """Return the promise without which this one cannot be checked, or ""."""
        if not self._waits:
            return ""
        if promise.tier is Tier.PLATINUM:
            # A load on a robot that is not gold says nothing of the load.
            return next((name for name, tier in self._lacking.items() if tier is not promise.tier), "")
        return promise.needs if promise.needs in self._lacking else ""

    def check(self, promise: Promise) -> CheckResult:
        """Check a promise, or say which one it waits for."""
        needed = self.blocked(promise)
        result = waiting(promise, needed) if needed else self._check(promise)
        if result.mark not in GOOD:
            self._lacking[promise.name] = promise.tier
        return result


def waiting(promise: Promise, needed: str) -> CheckResult:
    """Return the result of a promise that waits for another one."""
    said = f"{needed} did not pass, without which it cannot be checked"
    return replace(promise.result(CheckMark.NOT_PROVEN, said), waits_for=needed)


def unserved(problem: Exception) -> CheckResult:
    """Return the result of a robot that could not be served."""
    return MADE.result(CheckMark.FAILED, f"it could not be served: {type(problem).__name__}: {problem}")


def _check_each(
    chosen: Iterable[Promise],
    check: Callable[[Promise], CheckResult],
    tell: Callable[[CheckResult], None],
    checking: Callable[[str], None] = lambda check: None,
    *,
    then: Callable[[], None] = lambda: None,
    waits: bool = True,
) -> None:
    """Check one promise after the other; ``waits`` for those that each needs."""
    checks = PromiseChecks(check, waits=waits)
    for each in chosen:
        if checks.blocked(each):
            tell(checks.check(each))
            continue
        checking(each.name)
        tell(checks.check(each))
        then()
