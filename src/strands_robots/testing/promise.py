"""Promises of a robot, each with the check that proves it."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

from strands_robots.errors import StrandsRobotsError
from strands_robots.testing.bench import ConformanceBench, DriftError, NotKeptError, NotProvenError
from strands_robots.testing.report import CheckMark, CheckResult, Tier

Proof = Callable[[ConformanceBench], str | None]
"""Checks a promise; returns what it saw, and raises where the promise is not kept."""


NO_RECORDER = "the subject has no recorder of its bus (docs/your-robot.md, The bus and its recorder)"


@dataclass(frozen=True, slots=True)
class Promise:
    """One promise: what it says, why it matters, where to look when it is not kept.

    Attributes:
        name: ``tier.word``, by which an exemption names it.
        needs_recorder: it is about writes of the bus, so without a recorder it is not proven.
    """

    name: str
    tier: Tier
    text: str
    why: str
    look: str
    proof: Proof
    needs_recorder: bool = False
    needs: str = ""
    """Promise without which this one cannot be checked."""

    def check(self, bench: ConformanceBench) -> CheckResult:
        """Check it on a bench; never raises for what the robot does."""
        exempt = bench.subject.exempt.get(self.name, "")
        began = time.monotonic()
        bench.raised.take()
        mark, said = self._judged(bench)
        if mark is not CheckMark.PASSED and (raised := bench.raised.take()):
            said = f"{said}; the robot raised {', then '.join(raised)}"
        if exempt:
            kept = mark is CheckMark.PASSED
            mark = CheckMark.STALE if kept else CheckMark.EXEMPT
            said = f"it is kept, and exempt because: {exempt}" if kept else exempt
        return self.result(mark, said, time.monotonic() - began)

    def result(self, mark: CheckMark, said: str, seconds: float = 0.0) -> CheckResult:
        """Return a result of this promise."""
        return CheckResult(self.name, self.tier, mark, said, self.text, self.why, self.look, round(seconds, 3))

    def facts(self) -> dict[str, str]:
        """Return what it says, as JSON can carry it."""
        return {
            **{"check": self.name, "tier": self.tier.label, "promise": self.text},
            **{"matters": self.why, "look": self.look, "needs": self.needs},
        }

    def _judged(self, bench: ConformanceBench) -> tuple[CheckMark, str]:
        if self.needs_recorder and bench.subject.recorder is None:
            return CheckMark.NOT_PROVEN, NO_RECORDER
        return judged(lambda: self.proof(bench))


def judged(proof: Callable[[], str | None]) -> tuple[CheckMark, str]:
    """Return the mark of a proof, and what it said."""
    try:
        return CheckMark.PASSED, proof() or ""
    except NotProvenError as exc:
        return CheckMark.NOT_PROVEN, str(exc)
    except DriftError as exc:
        return CheckMark.DRIFT, str(exc)
    except (NotKeptError, StrandsRobotsError) as exc:
        return CheckMark.FAILED, str(exc)
    except Exception as exc:  # noqa: BLE001 - a robot of a stranger raises what it likes
        return CheckMark.FAILED, f"{type(exc).__name__}: {exc}"


def promise(
    name: str, text: str, *, why: str, look: str, needs_recorder: bool = False, needs: str = ""
) -> Callable[[Proof], Promise]:
    """Declare the function below as the proof of a promise.

    ``name`` begins with its tier.
    """

    def declare(proof: Proof) -> Promise:
        tier = Tier[name.partition(".")[0].upper()]
        return Promise(name, tier, text, why, look, proof, needs_recorder, needs)

    return declare
