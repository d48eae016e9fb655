"""The engine that starts, watches and halts the tasks of a robot or a world.

A task is a rollout: of a policy, of a planned motion, or of a leader. Each start takes the same way:

1. The permit comes first. A stop that comes while the start waits, connects or loads is newer, and voids it.
2. Of two starts of one body the later one waits, also while the policy of the first is made. No other body does.
3. The policy is made, which may take a stranger's code its time.
4. Under the starting lock, under which a world is rebuilt as well, the body is free and ready, the policy fits the
   robot, the permit is still valid, and the rollout begins.

A halt takes none of these locks: it voids every permit and every loop before it waits for a device.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from typing import Any, NamedTuple

from strands_robots.envelope import error, success
from strands_robots.policies import create_policy, resolve_provider
from strands_robots.policies.base import Policy
from strands_robots.policies.check import RobotFacts
from strands_robots.policies.profiled import ProfiledPolicy
from strands_robots.policies.profiles import profiles
from strands_robots.policies.rollout import Body, Rollout, RolloutObservers, rollout_options
from strands_robots.policies.settling import Settlings
from strands_robots.safety.gate import MotionGate, MotionRefused, MotionRequest, Permit, Waiting
from strands_robots.safety.stop_targets import verbs_to_end
from strands_robots.safety.stopping import READ_EVERY_S, PendingVerdict, StopVerdict, halt_each
from strands_robots.stop_log import stop_logger
from strands_robots.utils import ValidationError

logger = stop_logger(__name__)


class NewTask(NamedTuple):
    """A task that is to start.

    Attributes:
        make: makes the rollout of a body by a permit, under the starting lock.
        load: makes the policy that ``make`` gets as its last argument, which is None without it.
    """

    make: Callable[[Body, Permit, Any], Rollout]
    load: Callable[[], Policy] | None = None


class TaskEngine:
    """Tasks of a robot's bodies. Thread-safe.

    Args:
        name: of the robot, in its log.
        body: returns the body of a name, the first one by default; raises :class:`ValidationError`.
        ready: called before a body moves; raises :class:`ValidationError` where it cannot.
        facts: returns what a policy is checked against, by the name of a body.
        rate: returns the robot's control rate in Hz.
        of_world: the bodies are several, and a verdict names each; else it says ``task`` and ``settling``.
    """

    def __init__(
        self,
        name: str,
        body: Callable[[str], Body],
        *,
        facts: Callable[[str], RobotFacts],
        rate: Callable[[], float],
        ready: Callable[[], None] = lambda: None,
        of_world: bool = False,
    ) -> None:
        self.gate, self.observers, self.settlings = MotionGate(), RolloutObservers(), Settlings()
        self.starting = threading.RLock()
        """Held while a task begins, and while a world is rebuilt."""
        self.waiting, self.waiting_leaders = Waiting(), Waiting()
        """Starts with leave that have not begun, by body and by leader."""
        self._name, self._of_world = name, of_world
        self._task_label = "" if of_world else "task"
        self.rate = rate
        self._body, self._ready, self._facts = body, ready, facts
        self._lines: dict[str, threading.RLock] = {}
        self.by_body: dict[str, Rollout] = {}
        """The running or the last task of each body."""
        self.by_leader: dict[str, Rollout] = {}
        """The running or the last session of each leader."""
        self._sends: set[Permit] = set()
        self._moved: dict[str, None] = {}
        self._halting: dict[str, None] = {}

    def of_policy(
        self,
        instruction: str,
        provider: str,
        duration: float,
        options: dict[str, Any],
        driver: Callable[[Policy], Policy] | None = None,
    ) -> NewTask:
        """Check a task by a policy, for :meth:`start`.

        Args:
            instruction: what it shall do, 1 to 2000 characters.
            provider: a registered policy, or the operator's profile of one.
            duration: seconds, above 0.
            options: of the policy and of its loop, which :func:`rollout_options` takes out.
            driver: makes what drives the robot of the policy; it drives itself by default.

        Raises:
            ValidationError: an argument outside its domain.
        """
        provider, hz = resolve_provider(provider), self.rate()
        profile = profiles().get(provider)
        if profile is not None:
            options = profile.loop_options(options, hz)
        chosen = rollout_options(instruction, duration, options, hz)

        def make(body: Body, permit: Permit, policy: Policy) -> Rollout:
            if isinstance(policy, ProfiledPolicy):
                policy.fit(self._facts(body.name))
            driving = policy if driver is None else driver(policy)
            return Rollout(body, driving, permit=permit, policy_name=provider, observers=self.observers, **chosen)

        return NewTask(make, partial(create_policy, provider, **options))

    def start(
        self, verb: str, name: str, new: NewTask, request: MotionRequest | None = None, *, leader: str = ""
    ) -> Rollout:
        """Start a task, as the head of this module says.

        Args:
            verb: its name in a refusal.
            name: of the body.
            new: makes the rollout.
            request: what it begins for; made now by default.
            leader: name of the leader whose session it is; a task of the body by default.

        Raises:
            MotionRefused: locked, halted since it was asked for, or the policy is not loaded yet.
            ValidationError: a body that is driven or not ready, or a policy that does not fit it.
        """
        permit = self.gate.permit(verb, request)
        label = self._body(name).name
        waiting = self.waiting_leaders if leader else self.waiting
        with waiting.until_begun(permit, leader or label), self.line(label):
            policy = None
            if new.load is not None:
                self.require_free(label)
                policy = new.load()
                if not permit.valid:
                    raise MotionRefused(error(_LATE.format(verb)))
            with self.starting:
                permit.check()
                body = self._body(label)
                self.require_free(label)
                self._ready()
                rollout = new.make(body, permit, policy)
                permit.check()
                (self.by_leader if leader else self.by_body)[leader or label] = rollout
                rollout.start()
                return rollout

    def line(self, name: str) -> threading.RLock:
        """Return the lock under which motions of one body begin, one after another."""
        return self._lines.setdefault(name, threading.RLock())

    def require_free(self, name: str) -> None:
        """Raise :class:`ValidationError` while something drives a body."""
        task = self.by_body.get(name)
        if self.by_leader or (task is not None and task.running):
            driver = self.occupied(name) or self.leader_of(name)
            if driver:
                raise ValidationError(f"{name} is driven by {driver}; stop that first.")

    @contextmanager
    def sending(self, permit: Permit) -> Iterator[None]:
        """Mark the time in which a single action is sent."""
        self._sends.add(permit)
        try:
            yield
        finally:
            self._sends.discard(permit)

    def running(self) -> dict[str, Rollout]:
        """Return the running tasks by body."""
        return {name: task for name, task in list(self.by_body.items()) if task.running}

    def leading(self) -> dict[str, Rollout]:
        """Return the running sessions by leader."""
        return {name: session for name, session in list(self.by_leader.items()) if session.running}

    def driving(self) -> list[Rollout]:
        """Return all that run: tasks, and sessions of leaders."""
        return [*self.running().values(), *self.leading().values()]

    def leader_of(self, name: str) -> str:
        """Return the leader that drives a body; empty when none does."""
        return next((leader for leader, session in self.leading().items() if session.robot == name), "")

    def occupied(self, name: str) -> str:
        """Name the task that drives a body, for a refusal; empty when none does."""
        task = self.by_body.get(name)
        if task is None or not task.running:
            return ""
        instruction = repr(task.instruction)
        return f"the policy {task.policy_name} ({instruction})" if self._of_world else f"the task {instruction}"

    def moving(self) -> list[str]:
        """Name what moves now, as a verdict does."""
        names = [self._task_label or name for name, task in list(self.by_body.items()) if task.running]
        names += [f"teleoperation {leader}" for leader, session in list(self.by_leader.items()) if session.running]
        if self.settlings.by_body:
            names += [f"settling {name}" if self._of_world else "settling" for name in self.settlings.running()]
        return names + ["send_action"] * bool(self._sends)

    def note_motion(self) -> None:
        """Note what moves before a halt: a loop whose permit is void counts as halted."""
        self._moved.update(dict.fromkeys(self.moving()))

    def noted(self) -> dict[str, None]:
        """Return what moves, or was moving when a halt that is not over was ordered."""
        return dict.fromkeys([*self._halting, *self._moved, *self.moving()])

    def void(self) -> dict[str, Rollout]:
        """Void every running loop; return them as a verdict names them."""
        loops = {self._task_label or name: task for name, task in list(self.by_body.items()) if task.running}
        loops |= {f"teleoperation {leader}": each for leader, each in list(self.by_leader.items()) if each.running}
        for loop in loops.values():
            loop.void()
        return loops

    @contextmanager
    def halting(self, deadline: float, *, revoke: bool = True, settles: bool = True) -> Iterator[Halt]:
        """Void every permit and loop; the robot is frozen inside.

        The ends of the loops are left to be read.

        Args:
            deadline: monotonic s until which the loops' ends are waited for.
            revoke: false where the caller has voided the permits.
            settles: false to leave an arm frozen that would settle.
        """
        # Counted before the wait for a bus: a motion that is allowed meanwhile goes on after the freeze.
        given = self.gate.given
        moved = self._halting = dict.fromkeys([*self._moved, *self.moving()])
        self._moved = {}
        halt = Halt()
        halt.generation = self.gate.revoke() if revoke else self.gate.generation
        loops = self.void()
        try:
            yield halt
        except Exception as exc:  # noqa: BLE001 - a device may raise anything; the verdict says what
            halt.verdict = unfrozen(failure(self._name, exc), moved)
        else:
            then = partial(self.settlings.after, self.gate, halt.generation, given) if settles else _unchanged
            halt.verdict = RolloutsEnd(moved, loops, deadline, then, verbs_to_end(self.gate.under_way)).at_once()
        finally:
            self._halting = {}


class Halt:
    """A halt under way.

    Attributes:
        generation: of the newest halt that the freezing of the robot serves.
        verdict: on the halt, once it is over.
    """

    generation = 0
    verdict: StopVerdict | PendingVerdict = StopVerdict()


def _unchanged(verdict: StopVerdict) -> StopVerdict:
    return verdict


class RolloutsEnd(PendingVerdict):
    """Verdict of a halt that has voided loops, and does not wait for their ends.

    Args:
        moved: what has moved and was frozen.
        loops: the voided rollouts, by what a verdict calls them.
        until: the moment, in monotonic s, until which their ends are waited for.
        then: makes the final verdict.
        moves: returns True while something else of the robot has to end; at last the verdict is without ``then``.
    """

    def __init__(
        self,
        moved: Iterable[str],
        loops: Mapping[str, Rollout],
        until: float,
        then: Callable[[StopVerdict], StopVerdict] = _unchanged,
        moves: Callable[[], bool] = lambda: False,
    ) -> None:
        self._moves = moves
        # The reading itself waits for the end of a loop.
        super().__init__(until, pause_s=0.0)
        self._moved, self._loops, self._then = tuple(moved), loops, then
        self._final: StopVerdict | None = None
        self._interrupted = self._answered_for = False

    def at_once(self) -> StopVerdict | PendingVerdict:
        """Return the verdict where nothing has to end, else this."""
        return self if self._loops or self._moves() else self._then(self._found())

    def known(self) -> StopVerdict | None:
        return self.judged(None, last=False)

    def read(self) -> None:
        if not self._interrupted:
            self._interrupted = True
            for each in self._loops.values():
                each.interrupt()
        for each in self._loops.values():
            if each.running:
                each.join(READ_EVERY_S)
                return

    def judged(self, reading: object, *, last: bool) -> StopVerdict | None:
        found, moves = self._found(), self._moves()
        if self._final is None and ((found.stopped and not moves) or last):
            # Once, and in time: it may have the robot settle, of which the answer must say so.
            self._final = found if self._answered_for or moves else self._then(found)
        return self._final

    def unread(self, why: str) -> StopVerdict:
        self._answered_for = True
        return self._found()

    def _found(self) -> StopVerdict:
        still = success("Stopped.", stopped=True)
        ends = {name: partial(each.ended_by, time.monotonic()) for name, each in self._loops.items()}
        return halt_each({**{name: lambda: still for name in self._moved}, **ends})


def failure(name: str, exc: Exception) -> str:
    """Log why a robot was not frozen; return it."""
    problem = f"it could not be frozen: {type(exc).__name__}: {exc}"
    logger.critical("%s did not stop: %s", name, problem)
    return problem


def unfrozen(problem: str, moving: Mapping[str, None]) -> StopVerdict:
    """Return the verdict on a robot that is perhaps not frozen."""
    return StopVerdict(not_stopped=dict.fromkeys(moving, problem), unknown={} if moving else {"bus": problem})


_LATE = (
    "{} is refused: the robot was halted after it was asked for (halted while its policy was made ready); "
    "nothing was started."
)
