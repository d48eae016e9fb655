"""Adapter of one foreign robot: any object as a robot with tasks."""

from __future__ import annotations

import time
from collections.abc import Mapping
from concurrent.futures import Future, wait
from functools import partial
from typing import Any

from strands_robots import settings
from strands_robots.adapted.foreign import (
    NO_STOP,
    SILENT,
    STATUS_SHARE,
    TASK_VERBS,
    JointReader,
    answer_of,
    facts_of,
    given,
    no_tasks,
    shared_state,
    stops_motions,
    teleoperation_stopped_after,
    warn_once,
    with_reason,
)
from strands_robots.contract import (
    AT_REST,
    RUNNING,
    Observer,
    Unsubscribe,
    for_request,
    stated_name,
)
from strands_robots.envelope import Envelope, error, success
from strands_robots.safety.gate import MotionRefused, MotionRequest, gate_of
from strands_robots.safety.stop_executor import stop_executor
from strands_robots.safety.stop_targets import RobotWrapper
from strands_robots.safety.stopping import (
    PendingVerdict,
    StopVerdict,
    grade,
    halt_each,
    halts_in_parts,
    json_blocks,
    read_verdict,
)
from strands_robots.stop_log import stop_logger
from strands_robots.utils import shown
from strands_robots.verb_declaration import declared_verbs

logger = stop_logger(__name__)


class AdaptedRobot(RobotWrapper):
    """Foreign robot behind the contract; its own optional verbs are used.

    What it lacks is refused by name. A robot with verbs of its own (``@verb``) may have no tasks at all: its verbs are
    stopped by their permits, and it has no task status and no features unless it says so.
    """

    def __init__(self, robot: Any, joints: JointReader | None = None) -> None:
        self.wrapped = robot
        self._read_joints = joints
        usual = "robot" if callable(getattr(robot, "start_task", None)) else type(robot).__name__.lower()
        self.tool_name_str: str = stated_name(robot, usual)
        self._shared = shared_state(robot)
        self.gate = gate_of(robot)
        self._declares_verbs = bool(declared_verbs(robot))

    @property
    def halts(self) -> bool:
        """False where neither the robot nor the end of its permits can stop it."""
        wrapped = self.wrapped
        by_permits = self._declares_verbs and not callable(getattr(wrapped, "start_task", None))
        return by_permits or stops_motions(wrapped)

    @property
    def lacks(self) -> tuple[str, ...]:
        """The verbs of the contract that it refuses by name."""
        if self._declares_verbs and self.halts:
            return ()
        return tuple(verb for verb in TASK_VERBS if not callable(getattr(self.wrapped, verb, None)))

    def warn_endless(self, name: str) -> None:
        """Warn once in the robot's life, where it has no way to halt."""
        warn_once(self._shared, name, halts=self.halts)

    def start_task(
        self,
        instruction: str,
        policy_provider: str = "mock",
        duration: float = 30.0,
        policy_port: int = 0,
        *,
        request: MotionRequest | None = None,
    ) -> Envelope:
        start = getattr(self.wrapped, "start_task", None)
        if not callable(start):
            return error(no_tasks(self.lacks, self.tool_name_str))
        busy = self.gate.under_way.name
        if busy:
            return error(f"start_task is refused: {busy} of {self.tool_name_str} has not returned.")
        try:
            permit = self.gate.permit("start_task", request)
            permit.wait()
            permit.check()
        except MotionRefused as refused:
            return refused.envelope
        with self._shared.calling():
            task = {"policy_provider": policy_provider, "duration": duration, "policy_port": policy_port}
            answer: Envelope = for_request(permit.request, start)(instruction, **task)
        if not permit.valid:
            # The stop came while the robot was starting, and may have found nothing to stop.
            permit.begin()
            again = self.halt("halted while it started")
            end = "and was stopped again" if again.stopped else "and DID NOT STOP AGAIN"
            return error(f"start_task is refused: {self.tool_name_str} was halted while it started, {end}.")
        return answer

    def stop_task(self) -> Envelope:
        """Stop the task; the robot's own answer where its status does not contradict it."""
        stop = getattr(self.wrapped, "stop_task", None)
        if self.gate.under_way or not callable(stop):
            return self.halt("stop_task").envelope()
        with self._shared.calling():
            answer: Envelope | None = stop()
        verdict = read_verdict(StatusAfter(self, {"task": answer}))
        return answer if answer is not None and verdict.stopped else verdict.envelope()

    def get_task_status(self) -> Envelope:
        """Return the robot's own status; while a verb of its own runs, that."""
        own = getattr(self.wrapped, "get_task_status", None)
        verb = self.gate.under_way.name
        if callable(own):
            answer: Envelope = own()
            if not verb or not isinstance(answer, Mapping) or _task_status(answer) in RUNNING:
                return answer
        if not verb and "get_task_status" in self.lacks:
            return error(f"{self.tool_name_str} exposes no get_task_status.", task_status="unknown")
        if not verb:
            return success("Nothing runs.", task_status="idle")
        return success(f"{verb} runs.", task_status="running", instruction=verb, verb=verb)

    def get_features(self) -> Envelope:
        """Return the robot's own features, or none."""
        own = getattr(self.wrapped, "get_features", None)
        if not callable(own) and "get_features" in self.lacks:
            return error(f"{self.tool_name_str} exposes no get_features.")
        if not callable(own):
            return success("It states no features.", observation_features={}, action_features={})
        answer: Envelope = own()
        return answer

    def get_state(self) -> Envelope:
        """Return the robot's own state, else its joints, ``joints_age_s`` and task.

        While its task runs, or it is being started or stopped, its joints are not read: it drives its bus itself, and
        does not know of our turns on it. They are then those of the last read, and ``joints_error`` says so.
        """
        own = getattr(self.wrapped, "get_state", None)
        if callable(own):
            answer: Envelope = own()
            return answer
        # One at a time, so that one that waited looks anew at what the robot does. No stop ever waits for this.
        with self._shared.reading:
            task = facts_of(self.get_task_status())
            problem = self._refresh(_task_status(task) or "")
            read_at, joints = self._shared.read or (None, {})
        fields: dict[str, Any] = {"joints": dict(joints), "task": task}
        fields["joints_age_s"] = None if read_at is None else round(time.monotonic() - read_at, 4)
        if problem:
            fields["joints_error"] = problem
        return success(problem or f"{len(joints)} joints.", **fields)

    def subscribe(self, observer: Observer) -> Unsubscribe:
        subscribe = getattr(self.wrapped, "subscribe", None)
        unsubscribe: Unsubscribe = subscribe(observer) if callable(subscribe) else lambda: None
        return unsubscribe

    @halts_in_parts
    def halt(self, reason: str = "") -> StopVerdict:
        """The robot's own ``halt`` where it has one, else its task and its teleoperation.

        Its status is read afterwards: a robot that says that its task runs has not stopped, whatever it answered.
        """
        # A stop or a status of a stranger may hang, and the caller of a halt waits for its deadline at most.
        return stop_executor().halt(self, self.tool_name_str, reason)

    def halt_here(self, reason: str, deadline: float) -> StopVerdict | PendingVerdict:
        """Ask everything to stop, and leave the answers and the status to be read."""
        self.gate.revoke()
        with self._shared.calling():
            own, task, teleoperation = (
                getattr(self.wrapped, verb, None) for verb in ("halt", "stop_task", "stop_teleoperate")
            )
            answers: dict[str, object] = {}
            if callable(own):
                answers[self.tool_name_str] = answer_of(with_reason(own, reason))
            elif callable(task):
                with teleoperation_stopped_after(self.wrapped, self._shared, reason) as besides:
                    answers["task"] = answer_of(task)
                answers |= besides
            elif callable(teleoperation):
                answers["teleoperation"] = answer_of(teleoperation)
        if not self.halts:
            others = {name: partial(given, answer) for name, answer in answers.items()}
            return halt_each({self.tool_name_str: partial(error, NO_STOP), **others})
        # Where there is none, its verbs return when their permits are void, which the stop executor waits for.
        return StatusAfter(self, answers) if answers else StopVerdict()

    def _refresh(self, status: str) -> str:
        """Read the joints unless a call is disturbed; else return the reason."""
        if self._read_joints is None:
            return ""
        busy = "it is being started or stopped" if self._shared.called else "its task runs" if status in RUNNING else ""
        if busy:
            known = self._shared.read
            # A robot without joints has none that could be old.
            none = known is not None and not known[1]
            return "" if none else f"The joints are those of the last read: {busy}."
        began = time.monotonic()
        try:
            self._shared.read = (began, dict(self._read_joints(self.wrapped)))
        except Exception as exc:  # noqa: BLE001 - a bus raises what it likes; the answer says what
            return f"The joints could not be read: {type(exc).__name__}: {exc}"
        return ""


class StatusAfter(PendingVerdict):
    """Answers of a foreign robot to a stop, and its status after them.

    Args:
        answers: by what was asked to stop, or their futures; the status may contradict the first, which is none.
    """

    def __init__(self, robot: AdaptedRobot, answers: Mapping[str, object]) -> None:
        super().__init__(time.monotonic() + STATUS_SHARE * settings.number("STRANDS_HALT_DEADLINE_S"))
        self._robot, self._answers = robot, dict(answers)
        self._main = next(iter(answers))
        self._name = robot.tool_name_str
        self._open = [each for each in answers.values() if isinstance(each, Future)]
        self._has_status = callable(getattr(robot.wrapped, "get_task_status", None))

    def known(self) -> StopVerdict | None:
        refused = grade(self._answers[self._main]).stopped is False
        settled = self._settled() and (refused or not self._has_status)
        return self._verdict(self._answers[self._main]) if settled else None

    def read(self) -> str | None:
        wait(self._open, max(0.0, self.until - time.monotonic()))
        if not self._has_status:
            return None
        try:
            return _task_status(self._robot.wrapped.get_task_status())
        except Exception:
            logger.exception("%s: its status could not be read after a stop.", self._name)
            return None

    def judged(self, reading: object, *, last: bool) -> StopVerdict | None:
        answer = self._answers[self._main]
        if not last and not self._settled():
            return None
        if grade(answer).stopped is False or not self._has_status:
            return self._verdict(answer)
        if reading in RUNNING:
            if not last:
                return None
            return self._verdict(
                error(f"its get_task_status says {reading} after the stop, which answered {shown(answer)}")
            )
        if reading not in AT_REST:
            # Text is an unknown answer to a stop.
            return self._verdict("task_status is none of idle, stopped, completed, error, running")
        return self._verdict(success("Stopped.", stopped=True) if answer is None else answer)

    def unread(self, why: str) -> StopVerdict:
        return StopVerdict(not_stopped={self._main: f"{why}: its stop has returned, its status has not"})

    def _settled(self) -> bool:
        return all(each.done() for each in self._open)

    def _verdict(self, main: object) -> StopVerdict:
        answers = {name: _settled_answer(answer) for name, answer in (self._answers | {self._main: main}).items()}
        return halt_each({name: partial(given, answer) for name, answer in answers.items()})


def _settled_answer(answer: object) -> object:
    if not isinstance(answer, Future):
        return answer
    return answer.result() if answer.done() else error(SILENT)


def _task_status(answer: object) -> str | None:
    """Return the ``task_status`` of an answer, beside its content or inside it."""
    facts = [answer, *json_blocks(answer)] if isinstance(answer, Mapping) else []
    words = [fact["task_status"] for fact in facts if isinstance(fact.get("task_status"), str)]
    return words[0].lower() if words else None
