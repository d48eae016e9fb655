"""Stops of a world and of its robots, one of them as a world, and stops that wait."""

from __future__ import annotations

import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, cast

from strands_robots import settings
from strands_robots.adapted import RUNS_ON, STATUS_SHARE, AdaptedWorld
from strands_robots.contract import Haltable, Observer, Unsubscribe, WorldRobot, for_request
from strands_robots.envelope import Envelope, error
from strands_robots.recording.cameras import has_cameras
from strands_robots.safety.gate import MotionRequest
from strands_robots.safety.stop_executor import StopExecutor, stop_executor
from strands_robots.safety.stop_targets import StopOfRobot
from strands_robots.safety.stopping import (
    READ_EVERY_S,
    PendingVerdict,
    StopVerdict,
    explain,
    graded,
    halt_each,
    halts_in_parts,
    read_verdict,
    verdict_of,
)
from strands_robots.serving.workers import UNBOUNDED
from strands_robots.stop_log import stop_logger
from strands_robots.utils import ValidationError


@dataclass(frozen=True)
class WorldStop:
    """Stop everything in a world: halt all, then read each rollout's end."""

    world: WorldRobot

    @halts_in_parts
    def halt(self, reason: str = "") -> StopVerdict:
        """Halt the world and grade each rollout; an error outweighs success."""
        return read_verdict(self.halt_here(reason, 0.0))

    def halt_here(self, reason: str, deadline: float) -> PendingVerdict:
        """Order the halt of the world; leave its rollouts to be read.

        The halt comes first: a policy that hangs would have the others move on while its own stop waits for it. It has
        its own deadline, so that one that hangs leaves the rollouts their own stops.
        """
        world = self.world
        # A world that notes its motion lists it at once. Any other is listed after its halt, for that may hang.
        before = _Rollouts(world) if hasattr(type(world), "halt_ordered") else None
        return _WorldEnds(world, stop_executor().submit(world, world.tool_name_str, reason), before)


class _Rollouts:
    """Names of the robots of a world whose rollouts run, or the reason why they are not known."""

    def __init__(self, world: WorldRobot) -> None:
        self.running: list[str] = []
        self.unlisted: dict[str, str] = {}
        try:
            self.running = [str(row.get("robot", "")) for row in world.list_policies_running()]
        except Exception as exc:  # noqa: BLE001 - a world that changes under the stop is halted as a whole
            self.unlisted = {"rollouts": explain(exc)}


class _WorldEnds(PendingVerdict):
    """Verdict on a world whose halt was ordered, and on each of its rollouts."""

    def __init__(self, world: WorldRobot, halting: Future[StopVerdict], before: _Rollouts | None) -> None:
        super().__init__(0.0)
        self._world, self._halting, self._before = world, halting, before

    def known(self) -> None:
        return None

    def read(self) -> StopVerdict:
        rest = self._rest()
        listed = self._before or _Rollouts(self._world)
        # A world that settles has answered for its rollouts, and a second stop would freeze it.
        asked = [] if rest.settling else [name for name in listed.running if name not in rest.not_stopped]
        rollouts = halt_each({name: RobotStop(self._world, name).stop for name in asked})
        return replace(rollouts, unknown={**rollouts.unknown, **listed.unlisted})

    def judged(self, reading: object, *, last: bool) -> StopVerdict:
        rest, rollouts = self._rest(), graded(reading, self._world.tool_name_str)
        return StopVerdict(
            (*rollouts.halted, *(name for name in rest.halted if name not in rollouts.halted)),
            {**rest.not_stopped, **rollouts.not_stopped},
            {**rest.unknown, **rollouts.unknown},
            rest.elapsed_ms + rollouts.elapsed_ms,
            rest.settling,
        )

    def unread(self, why: str) -> StopVerdict:
        return StopVerdict(not_stopped={self._world.tool_name_str: why})

    def _rest(self) -> StopVerdict:
        # The executor answers at the latest when the deadline is over, behind another halt when it is over twice.
        return self._halting.result(2 * settings.number("STRANDS_HALT_DEADLINE_S") + 1.0)


@dataclass(frozen=True)
class RobotStop(StopOfRobot):
    """The stop of one robot of a world."""

    world: WorldRobot
    name: str

    def stopped_robot(self) -> WorldRobot:
        """Return the world, of whose own verbs each may move this robot."""
        return self.world

    def stop(self) -> Envelope:
        """Stop the robot's rollout."""
        return self.world.stop_policy(self.name)

    def halt(self, reason: str = "") -> StopVerdict:
        """Stop the robot's rollout and grade the answer."""
        return verdict_of(self.stop, self.name)


@dataclass(frozen=True)
class _StrangersStop(RobotStop):
    """Stop of one robot of a foreign world, whose list is read after it: it may hang."""

    leaves: bool
    """True for a robot that its world had, and that stands still where it has it no more."""

    def halt(self, reason: str = "") -> StopVerdict:
        """Stop the robot's rollout; the answer counts for a robot that is there."""
        verdict = super().halt(reason)
        try:
            robots = cast(AdaptedWorld, self.world).listed()
        except Exception as exc:  # noqa: BLE001 - a stranger's list raises what it likes
            doubt = StopVerdict(unknown={self.name: f"whether it is there is not known: {explain(exc)}"})
            return doubt if verdict.stopped else verdict
        if robots is None or self.name in robots:
            return self._at_rest(verdict)
        return StopVerdict() if self.leaves else StopVerdict(not_stopped={self.name: _no_robot(robots)})

    def _at_rest(self, verdict: StopVerdict) -> StopVerdict:
        """Return the verdict unless the world goes on listing the robot as running."""
        runs = cast(AdaptedWorld, self.world).runs
        until = time.monotonic() + STATUS_SHARE * settings.number("STRANDS_HALT_DEADLINE_S")
        while verdict.stopped and runs is not None and self.name in runs():
            if time.monotonic() >= until:
                return StopVerdict(not_stopped={self.name: RUNS_ON})
            time.sleep(READ_EVERY_S)
        return verdict


def _no_robot(robots: Sequence[str]) -> str:
    return f"there is no robot of this name; the robots here are {', '.join(robots) or 'none'}"


def robot_stop(world: WorldRobot, name: str) -> RobotStop:
    """Return the stop of the named robot of a world.

    Raises:
        ValidationError: the world has no robot of this name; a stranger's is asked when it is stopped.
    """
    if isinstance(world, AdaptedWorld):
        return _StrangersStop(world, name, leaves=False)
    robots = world.list_robots()
    if name not in robots:
        raise ValidationError(_no_robot(robots))
    return RobotStop(world, name)


def stop_within(target: object) -> float | None:
    """Return the seconds for a stop; None for the halt deadline.

    A stop of a world or of one of its robots waits for the rollouts' own answers besides.
    """
    own_word = isinstance(target, WorldStop | RobotStop)
    return 2 * settings.number("STRANDS_HALT_DEADLINE_S") + 1.0 if own_word else None


logger = stop_logger(__name__)

CALLER_MAX = 256
"""Stops of one caller that wait for an answer; beyond it the caller's oldest loses its own."""

TOTAL_MAX = 4096
"""The same for all callers; beyond it the one with the most loses the answer to its oldest."""

Request = tuple[str, str]
"""Caller and turn."""

Answer = Callable[[StopVerdict, list[Request]], None]
"""Answers requests that share a verdict."""


class StopRequests:
    """Stops of one peer without an answer.

    Args:
        answer: called on a thread of the pool, one call at a time.
        executor: carries out the stops.
    """

    def __init__(self, answer: Answer, executor: Callable[[], StopExecutor] = stop_executor) -> None:
        self._answer = answer
        self._executor = executor
        self._waiting: dict[Request, None] = {}
        self._by_caller: Counter[str] = Counter()
        self._verdicts: deque[tuple[StopVerdict, Request]] = deque()
        self._answering = False
        self._lock = threading.Lock()
        self.unanswered = 0

    def __len__(self) -> int:
        return len(self._waiting)

    def add(self, target: Haltable, name: str, reason: str, request: Request, *, within: float | None = None) -> None:
        """Have ``target`` halted and ``request`` answered; return at once."""
        with self._lock:
            if request not in self._waiting:
                self._waiting[request] = None
                self._by_caller[request[0]] += 1
            if self._by_caller[request[0]] > CALLER_MAX:
                self._forget(request[0])
            elif len(self._waiting) > TOTAL_MAX:
                self._forget(self._by_caller.most_common(1)[0][0])
        self._executor().submit(target, name, reason, within=within).add_done_callback(partial(self._halted, request))

    def _halted(self, request: Request, halted: Future[StopVerdict]) -> None:
        with self._lock:
            if request not in self._waiting:
                return
            self._verdicts.append((halted.result(), request))
            begin, self._answering = not self._answering, True
        if begin:
            UNBOUNDED.submit(self._answer_all)

    def _answer_all(self) -> None:
        while True:
            with self._lock:
                due, self._verdicts = self._verdicts, deque()
                if not due:
                    self._answering = False
                    return
            try:
                for verdict, requests in _grouped(due):
                    self._answer(verdict, requests)
            except Exception:
                logger.exception("The answers to a stop failed.")
            finally:
                with self._lock:
                    for _, request in due:
                        self._release(request)

    def _forget(self, caller: str) -> None:
        oldest = next((request for request in self._waiting if request[0] == caller), None)
        if oldest is not None:
            self._release(oldest)
            self.unanswered += 1

    def _release(self, request: Request) -> None:
        if request in self._waiting:
            del self._waiting[request]
            self._by_caller[request[0]] -= 1
            self._by_caller = +self._by_caller


def _grouped(due: deque[tuple[StopVerdict, Request]]) -> list[tuple[StopVerdict, list[Request]]]:
    """Merge requests of the same target; a repeated one is answered once."""
    groups: dict[tuple[object, ...], tuple[StopVerdict, dict[Request, None]]] = {}
    answered: set[Request] = set()
    for verdict, request in due:
        if request in answered:
            continue
        answered.add(request)
        same = (verdict.halted, tuple(verdict.not_stopped.items()), tuple(verdict.unknown.items()))
        groups.setdefault(same, (verdict, {}))[1][request] = None
    return [(verdict, list(requests)) for verdict, requests in groups.values()]


class OneRobot:
    """One robot of a world, seen as a world that holds nothing else."""

    whole = False
    """Physics is stepped and reset by the world alone."""

    def __init__(self, world: WorldRobot, name: str) -> None:
        self._world = world
        self.tool_name_str = name
        self.gate = world.gate

    @property
    def has_cameras(self) -> bool:
        """True where the world has cameras."""
        return has_cameras(self._world)

    def arm_verbs(self, robot_name: str = "") -> frozenset[str]:
        """Return the verbs of an arm that the world carries out for it."""
        own = getattr(self._world, "arm_verbs", None)
        verbs: frozenset[str] = own(self.tool_name_str) if callable(own) else frozenset()
        return verbs

    def list_robots(self) -> list[str]:
        return [name for name in self._world.list_robots() if name == self.tool_name_str]

    def start_policy(
        self,
        robot_name: str,
        instruction: str,
        policy_provider: str = "mock",
        duration: float = 30.0,
        *,
        request: MotionRequest | None = None,
        **policy: Any,
    ) -> Envelope:
        policy |= {"policy_provider": policy_provider, "duration": duration}
        return for_request(request, self._world.start_policy)(robot_name, instruction, **policy)

    def stop_policy(self, robot_name: str) -> Envelope:
        return self._world.stop_policy(robot_name)

    def outcomes(self) -> dict[str, Any]:
        """Return how its last policy or motion ended, by its name."""
        ended: dict[str, Any] = getattr(self._world, "outcomes", dict)()
        return {name: ended[name] for name in ended if name == self.tool_name_str}

    def list_policies_running(self) -> list[dict[str, Any]]:
        return [row for row in self._world.list_policies_running() if row.get("robot") == self.tool_name_str]

    def get_state(self) -> Envelope:
        return self._own(self._world.get_state())

    def get_features(self) -> Envelope:
        return self._own(self._world.get_features())

    def step(self, n: int = 1) -> Envelope:
        return error(f"step: {self.tool_name_str} is one robot of a world; ask the world.")

    def reset(self) -> Envelope:
        return error(f"reset: {self.tool_name_str} is one robot of a world; ask the world.")

    def subscribe(self, observer: Observer) -> Unsubscribe:
        return self._world.subscribe(observer)

    def halt(self, reason: str = "") -> StopVerdict:
        """Stop this robot alone."""
        stop = self.stop_target()
        return StopVerdict() if stop is None else stop.halt(reason)

    def stop_target(self, name: str = "") -> RobotStop | None:
        """Return the stop of this robot; None when it left its world.

        Raises:
            ValidationError: ``name`` is another robot's.
        """
        if name not in ("", self.tool_name_str):
            raise ValidationError(f"there is no robot of this name; the robots here are {self.tool_name_str}")
        if isinstance(self._world, AdaptedWorld):
            return _StrangersStop(self._world, self.tool_name_str, leaves=True)
        return RobotStop(self._world, self.tool_name_str) if self.list_robots() else None

    def facts(self) -> dict[str, Any]:
        """Return its fields of presence."""
        running = self.list_policies_running()
        fields: dict[str, Any] = {
            "tool_name": self.tool_name_str,
            "task_status": "running" if running else "idle",
            "world": True,
            "sim_robots": [self.tool_name_str],
        }
        return fields | ({"instruction": str(running[0].get("instruction", ""))} if running else {})

    def _own(self, answer: Envelope) -> Envelope:
        robots = answer.get("robots")
        if not isinstance(robots, Mapping):
            return answer
        return {**answer, "robots": {name: robots[name] for name in robots if name == self.tool_name_str}}
