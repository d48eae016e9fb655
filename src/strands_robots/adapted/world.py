"""Adapter of a foreign simulation, whose robots are halted one by one."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Future, wait
from dataclasses import dataclass
from functools import partial
from typing import Any, cast

from strands_robots import settings
from strands_robots.adapted.foreign import (
    NO_STOP,
    ORDER_SHARE,
    SILENT,
    STATUS_SHARE,
    answer_of,
    given,
    shared_state,
    stops_motions,
    teleoperation_stopped_after,
    warn_once,
    with_reason,
)
from strands_robots.contract import (
    Observer,
    Unsubscribe,
    for_request,
    stated_name,
)
from strands_robots.envelope import Envelope, error
from strands_robots.safety.gate import MotionRefused, MotionRequest, gate_of
from strands_robots.safety.stop_executor import stop_executor
from strands_robots.safety.stop_targets import RobotWrapper
from strands_robots.safety.stopping import (
    PendingVerdict,
    StopVerdict,
    halt_each,
    halts_in_parts,
    verdict_of,
)
from strands_robots.stop_log import stop_logger
from strands_robots.utils import shown

logger = stop_logger(__name__)


RUNS_ON = "its world lists it as running after the stop"

_Halting = Mapping[str, Future[StopVerdict]]

_WORLD_VERBS = ("list_robots", "start_policy", "stop_policy", "list_policies_running", "get_state", "get_features")


class AdaptedWorld(RobotWrapper):
    """Foreign simulation behind a world's contract; what it lacks is refused by name."""

    def __init__(self, world: Any) -> None:
        self.wrapped = world
        self.tool_name_str: str = stated_name(world, "simulation")
        self.gate = gate_of(world)
        self._shared = shared_state(world)

    @property
    def halts(self) -> bool:
        """False where it has no way to halt that we know."""
        stops = self._own("list_robots") is not None and self._own("stop_policy") is not None
        return stops or stops_motions(self.wrapped)

    @property
    def lacks(self) -> tuple[str, ...]:
        """The verbs of the contract that it refuses by name."""
        return tuple(verb for verb in (*_WORLD_VERBS, "step", "reset") if self._own(verb) is None)

    def list_robots(self) -> list[str]:
        return self.listed() or []

    def listed(self) -> list[str] | None:
        """Return the names of its robots; None for a list that cannot be read."""
        names = _texts(self._ask("list_robots"))
        if names is not None:
            self._shared.known = dict.fromkeys(names)
        return names

    @property
    def runs(self) -> Callable[[], set[str]] | None:
        """Reads the names of robots whose policies run; None where it cannot say."""
        if self._own("list_policies_running") is None:
            return None
        return lambda: {row["robot"] for row in self.list_policies_running() if isinstance(row.get("robot"), str)}

    def list_policies_running(self) -> list[dict[str, Any]]:
        return [row for row in self._listed("list_policies_running") if isinstance(row, dict)]

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
        self._shared.known[robot_name] = None
        named = {"robot_name": robot_name, "instruction": instruction, "policy_provider": policy_provider}
        return self._motion("start_policy", request, **named, duration=duration, **policy)

    def stop_policy(self, robot_name: str) -> Envelope:
        return self._ask("stop_policy", robot_name=robot_name)

    def get_state(self) -> Envelope:
        return self._ask("get_state")

    def get_features(self) -> Envelope:
        return self._ask("get_features")

    def step(self, n: int = 1, *, request: MotionRequest | None = None) -> Envelope:
        return self._motion("step", request, n)

    def reset(self, *, request: MotionRequest | None = None) -> Envelope:
        return self._motion("reset", request)

    def subscribe(self, observer: Observer) -> Unsubscribe:
        subscribe = self._own("subscribe")
        unsubscribe: Unsubscribe = (lambda: None) if subscribe is None else subscribe(observer)
        return unsubscribe

    @halts_in_parts
    def halt(self, reason: str = "") -> StopVerdict:
        """The world's own ``halt`` or ``stop_task``, else ``stop_policy`` of each robot.

        Its teleoperation is stopped besides.
        """
        return stop_executor().halt(self, self.tool_name_str, reason)

    def halt_here(self, reason: str, deadline: float) -> StopVerdict | PendingVerdict:
        """Ask everything to stop: the robots that are known before the world is read.

        Each robot is stopped on a thread of the stop executor's, so that one that hangs leaves the others their stops.
        """
        self.gate.revoke()
        halt, stop = self._own("halt"), self._own("stop_task")
        whole = stop if halt is None else with_reason(halt, reason)
        answers: dict[str, object] = {}
        halting: dict[str, Future[StopVerdict]] = {}
        with teleoperation_stopped_after(self.wrapped, self._shared, reason) as besides:
            if whole is not None:
                answers[self.tool_name_str] = answer_of(whole)
            elif self.halts:
                patience = time.monotonic() + ORDER_SHARE * settings.number("STRANDS_HALT_DEADLINE_S")
                self._stop_each(tuple(self._shared.known), halting, reason, patience)
                listed = answer_of(partial(self._ask, "list_robots"))
                names = _texts(listed)
                if names is None:
                    answers[self.tool_name_str] = error(f"its robots could not be listed: {shown(listed)}")
                else:
                    for gone in halting.keys() - set(names):
                        del halting[gone]
                    self._shared.known = dict.fromkeys(names)
                    self._stop_each([name for name in names if name not in halting], halting, reason, patience)
            else:
                answers[self.tool_name_str] = error(NO_STOP)
        rest = halt_each({name: partial(given, answer) for name, answer in answers.items()})
        waits = halting or besides or self.runs is not None
        return _RobotsHalting(self, halting, besides, rest) if waits else rest

    def _stop_each(
        self, names: Iterable[str], halting: dict[str, Future[StopVerdict]], reason: str, patience: float
    ) -> None:
        """Have each robot stopped, in order while their answers come in time."""
        for name in names:
            halting[name] = stop_executor().submit(_OneOfWorld(self.wrapped, name), name, reason)
            wait([halting[name]], max(0.0, patience - time.monotonic()))

    def warn_endless(self, name: str) -> None:
        """Warn once in its life, where it has no way to halt."""
        warn_once(self._shared, name, halts=self.halts)

    def _own(self, verb: str) -> Callable[..., Any] | None:
        own = getattr(self.wrapped, verb, None)
        return own if callable(own) else None

    def _listed(self, verb: str) -> list[Any]:
        own = self._own(verb)
        answer = [] if own is None else own()
        return list(answer) if isinstance(answer, list | tuple) else []

    def _ask(self, verb: str, *values: Any, **named: Any) -> Envelope:
        own = self._own(verb)
        if own is None:
            return error(f"{self.tool_name_str} exposes no {verb}.")
        answer: Envelope = own(*values, **named)
        return answer

    def _motion(self, verb: str, request: MotionRequest | None, *values: Any, **named: Any) -> Envelope:
        if self._own(verb) is None:
            return self._ask(verb)
        try:
            permit = self.gate.permit(verb, request)
            permit.wait()
            permit.check()
        except MotionRefused as refused:
            return refused.envelope
        answer = for_request(permit.request, self._ask)(verb, *values, **named)
        if not permit.valid:
            permit.begin()
            again = self.halt("halted while it started")
            end = "and was stopped again" if again.stopped else "and DID NOT STOP AGAIN"
            return error(f"{verb} is refused: {self.tool_name_str} was halted meanwhile, {end}.")
        return answer


@dataclass(frozen=True)
class _OneOfWorld:
    """Target of the stop executor: one robot of a foreign world."""

    world: Any
    name: str

    def halt(self, reason: str = "") -> StopVerdict:
        """Stop its policy and grade the answer."""
        return verdict_of(lambda: given(self.world.stop_policy(robot_name=self.name)), self.name)


class _RobotsHalting(PendingVerdict):
    """Verdict on a foreign world: its robots that are being stopped, then what runs."""

    def __init__(self, world: AdaptedWorld, robots: _Halting, besides: _Halting, rest: StopVerdict) -> None:
        super().__init__(time.monotonic() + STATUS_SHARE * settings.number("STRANDS_HALT_DEADLINE_S"))
        self._runs, self._robots, self._rest = world.runs, tuple(robots), rest
        self._halting = {**robots, **besides}

    def known(self) -> StopVerdict | None:
        return self._verdict({}) if self._runs is None and self._answered() else None

    def read(self) -> set[str]:
        wait(self._halting.values(), max(0.0, self.until - time.monotonic()))
        return set() if self._runs is None else self._runs()

    def judged(self, reading: object, *, last: bool) -> StopVerdict | None:
        running = cast("set[str]", reading)
        return self._verdict(dict.fromkeys(running, RUNS_ON)) if last or (self._answered() and not running) else None

    def unread(self, why: str) -> StopVerdict:
        return self._verdict({} if self._runs is None else dict.fromkeys(self._robots, why))

    def _answered(self) -> bool:
        return all(each.done() for each in self._halting.values())

    def _verdict(self, goes_on: Mapping[str, str]) -> StopVerdict:
        silent = {name: StopVerdict(not_stopped={name: SILENT}) for name, each in self._halting.items()}
        ends = [each.result() if each.done() else silent[name] for name, each in self._halting.items()] + [self._rest]
        return StopVerdict(
            tuple(name for end in ends for name in end.halted if name not in goes_on),
            {**goes_on, **{name: said for end in ends for name, said in end.not_stopped.items()}},
            {name: said for end in ends for name, said in end.unknown.items()},
        )


def _texts(listed: object) -> list[str] | None:
    """Return the names in a list of robots; None for what may hide some."""
    if not isinstance(listed, list | tuple | set | frozenset):
        return None
    names = [name for name in listed if isinstance(name, str)]
    return names if len(names) == len(listed) else None
