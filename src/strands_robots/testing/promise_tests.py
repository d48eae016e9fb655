"""Promises of a robot as tests of pytest, one for each check."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack

import pytest

from strands_robots.testing.bench import ConformanceBench
from strands_robots.testing.conformance import MADE, PromiseChecks, chosen_of, promises, unserved, waiting
from strands_robots.testing.promise import Promise
from strands_robots.testing.report import BAD, CheckMark, CheckResult, Tier
from strands_robots.testing.subject import Subject
from strands_robots.utils import ValidationError, shown


def conformance_tests(
    subject: Subject | Callable[[], Subject], most: Tier = Tier.GOLD, *, proven: Tier | None = None
) -> type:
    """Return a class of tests, one for each promise of a robot.

    Give it a name that begins with ``Test``::

        TestPromises = conformance_tests(subject, proven=Tier.GOLD)

    The robot is made once, when the first of them runs, and moves on its emulated bus. A promise that is not kept
    fails, with why it matters and where to look. An exempt one is an expected failure with its reason. One that is not
    proven is skipped.

    Args:
        subject: the robot under test, or a callable that returns it.
        most: the highest tier that is checked.
        proven: up to this tier a promise that is not proven fails, too.

    Raises:
        ValidationError: an argument outside its domain.
    """
    if not isinstance(subject, Subject) and not callable(subject):
        raise ValidationError(f"subject must be a Subject or a callable that returns one, not {shown(subject)}.")
    for name, tier in {"most": most, "proven": proven}.items():
        if not isinstance(tier, Tier) and not (name == "proven" and tier is None):
            raise ValidationError(f"{name} must be a Tier, not {shown(tier)}.")
    runs: list[PromiseRun] = []

    def served(test: pytest.Item) -> PromiseRun:
        """Return the run of the class; it ends with the class."""
        if not runs:
            of_class = test.getparent(pytest.Class)
            assert of_class is not None
            runs.append(PromiseRun(subject if isinstance(subject, Subject) else subject()))
            of_class.addfinalizer(lambda: runs.pop().close())
        return runs[0]

    class PromiseTests:
        """Promises of a robot."""

        @pytest.mark.parametrize("promise", promises(most), ids=lambda promise: promise.name)
        def test_promise(self, request: pytest.FixtureRequest, promise: Promise) -> None:
            """Check one promise."""
            result = served(request.node).check(promise)
            # What waits for another check is not proven because of that one, which fails.
            needed = proven is not None and promise.tier.value <= proven.value and not result.waits_for
            if result.mark in BAD or (needed and result.mark is CheckMark.NOT_PROVEN):
                pytest.fail(result.words(), pytrace=False)
            if result.mark is CheckMark.EXEMPT:
                pytest.xfail(result.said)
            if result.mark is CheckMark.NOT_PROVEN:
                pytest.skip(f"{result.check} is not proven: {result.said}")

    return PromiseTests


class PromiseRun:
    """Robot of a subject on its bench, for the checks of it.

    Args:
        subject: makes the robot.

    Raises:
        ValidationError: an exemption from a check that does not exist.
    """

    def __init__(self, subject: Subject) -> None:
        chosen_of(Tier.PLATINUM, (), subject)
        self._stack = ExitStack()
        self._rest: Callable[[], None] = lambda: None
        try:
            bench = self._stack.enter_context(ConformanceBench(subject))
        except Exception as exc:  # noqa: BLE001 - a robot of a stranger raises what it likes
            broken = unserved(exc)
            self._checks = PromiseChecks(lambda each: broken if each is MADE else waiting(each, MADE.name))
        else:
            self._checks = PromiseChecks(lambda each: each.check(bench))
            self._rest = bench.rest

    def check(self, promise: Promise) -> CheckResult:
        """Check a promise, and have the robot stand still and unlocked again."""
        result = self._checks.check(promise)
        self._rest()
        return result

    def close(self) -> None:
        """Let go of the robot."""
        self._stack.close()
