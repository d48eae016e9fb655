"""A robot read into messages: its state, description and policy steps.

Each section and each field is read by itself: one that cannot be read takes no other with it. A robot's state is
published at 10 Hz while it moves and at 1 Hz while it is idle: more than 40 robots of a process that publish ten a
second each pass what Zenoh carries on a link, and states are lost.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

from strands_robots.adapted import lacks
from strands_robots.contract import RUNNING, Robot, RolloutEvent, Unsubscribe, body_of, holds_robots, robots_in
from strands_robots.envelope import is_error, text_of
from strands_robots.errors import StrandsRobotsError
from strands_robots.mesh import topics
from strands_robots.mesh.scheduler import TroubleLog, repeat
from strands_robots.mesh.session import Context
from strands_robots.mesh.transport import TransportError
from strands_robots.mesh.wire import WireError
from strands_robots.rate_limits import RateLimiter
from strands_robots.safety.gate import MotionGate, gate_of
from strands_robots.serving.peer_verbs import kind_of
from strands_robots.threads import BoundedExecutor
from strands_robots.utils import plain_scalar

logger = logging.getLogger(__name__)

TASK_FIELDS = {"status": "task_status", "instruction": "instruction", "steps": "step_count", "duration": "duration"}

DETAIL_MAX = 160
KEYS_MAX = 256
IMAGE_DIMENSIONS = 3
STALE_S = 1.0
"""Age in seconds from which joints of an earlier read are published no more."""

Fields = Mapping[str, Any]


class UnreadableError(StrandsRobotsError):
    """A section that cannot be read, or only in part.

    Attributes:
        reason: short code of the failure.
        part: the entries that were read.
    """

    def __init__(self, reason: str, detail: str, part: Fields | None = None) -> None:
        super().__init__(detail)
        self.reason = reason
        self.part = part or {}


@dataclass(slots=True)
class _Degradation:
    reason: str
    detail: str
    since: float
    failures: int = 0


class StateReader:
    """Reads a robot into state messages; a failed section is reported degraded."""

    def __init__(self, peer_id: str, robot: Robot | None, clock: Callable[[], float] = time.time) -> None:
        self._peer_id = peer_id
        self._world = robot if holds_robots(robot) else None
        self._arm = None if holds_robots(robot) else robot
        self._clock = clock
        self._degraded: dict[str, _Degradation] = {}
        self._positions: dict[str, tuple[float, float]] = {}

    def read(self) -> dict[str, Any] | None:
        """Return the message, or None when no section can be read and none is degraded."""
        body: dict[str, Any] = {}
        for name, read in self._sections().items():
            self._add_section(body, name, read)
        if self._degraded:
            now = time.monotonic()
            body["degraded"] = {
                name: {
                    "reason": each.reason,
                    "detail": each.detail,
                    "failures": each.failures,
                    "seconds": round(now - each.since, 3),
                }
                for name, each in self._degraded.items()
            }
        # Written last, so that a robot's own fields cannot pass for another peer.
        return {**body, "peer_id": self._peer_id, "t": self._clock()} if body else None

    def _sections(self) -> dict[str, Callable[[], Any]]:
        world, arm = self._world, self._arm
        if world is not None:
            # A read that succeeds is shared by the sections of one message.
            state, running, names = cache(world.get_state), cache(world.list_policies_running), cache(world.list_robots)
            return {
                "joints": lambda: self._world_joints(_checked(state()), names()),
                "sim_time": lambda: _sim_time(_checked(state())),
                "robots": lambda: _active(names(), running()),
                "task": lambda: _world_task(running()),
            }
        if arm is not None:
            return {
                "joints": lambda: _joints(_checked(arm.get_state())),
                "task": lambda: _task(_checked(arm.get_task_status())),
            }
        return {}

    def _add_section(self, body: dict[str, Any], name: str, read: Callable[[], Any]) -> None:
        try:
            section, reason, detail = read(), "", ""
        except UnreadableError as exc:
            section, reason, detail = exc.part, exc.reason, str(exc)
        except Exception as exc:  # noqa: BLE001 - whatever a robot's read raises is reported in the message
            section, reason, detail = None, type(exc).__name__, str(exc)
        if reason:
            degraded = self._degraded.setdefault(name, _Degradation("", "", time.monotonic()))
            degraded.reason = reason
            degraded.detail = detail if len(detail) <= DETAIL_MAX else f"{detail[:DETAIL_MAX]}..."
            degraded.failures += 1
        else:
            self._degraded.pop(name, None)
        if section is not None and section != {}:
            body[name] = section

    def _world_joints(self, state: Fields, names: list[str]) -> dict[str, Any]:
        joints: dict[str, Any] = {}
        at = state.get("sim_time")
        for name, values in dict(state.get("robots") or {}).items():
            inner = values.get("joints", values) if isinstance(values, Mapping) else {}
            for joint, value in inner.items():
                if isinstance(value, Mapping):
                    entry = {"position": value.get("position"), "velocity": value.get("velocity")}
                elif (position := _float(value)) is not None:
                    entry = {"position": position, "velocity": self._velocity(f"{name}/{joint}", position, at)}
                else:
                    continue
                joints[joint if len(names) == 1 else f"{name}/{joint}"] = entry
        bad = [name for name, entry in joints.items() if not all(_is_number_or_none(each) for each in entry.values())]
        return _without(joints, bad)

    def _velocity(self, joint: str, position: float, at: object) -> float | None:
        """Velocity by simulated time since the last message; None for the first."""
        now = _float(at)
        if now is None:
            return None
        known = self._positions.get(joint)
        self._positions[joint] = (now, position)
        if known is None:
            return None
        passed = now - known[0]
        return (position - known[1]) / passed if passed > 0 else 0.0


class Description:
    """Reads a robot for presence, field by field; failures are logged once."""

    def __init__(self, peer_id: str, robot: Robot | None, own_verbs: Collection[str] = ()) -> None:
        self._peer_id = peer_id
        self._own_verbs = sorted(own_verbs)
        self._robot = robot
        self._world = robot if holds_robots(robot) else None
        self._arm = None if holds_robots(robot) else robot
        self._kind = "" if robot is None else kind_of(robot)
        self._troubles = TroubleLog(logger)

    def read(self) -> dict[str, Any]:
        """Return the fields that can be read now."""
        robot, world, arm = self._robot, self._world, self._arm
        if robot is None:
            return {}
        fields: dict[str, Any] = {"tool_name": robot.tool_name_str, "robot_kind": self._kind}
        if self._own_verbs:
            fields["own_verbs"] = self._own_verbs
        if world is not None:
            fields["world"] = True
            fields.update(self._field("sim_robots", lambda: {"sim_robots": world.list_robots()}))
            if "list_policies_running" not in lacks(world):
                fields.update(self._field("task_status", lambda: _world_status(world.list_policies_running())))
            if "get_features" not in lacks(world):
                fields.update(self._field("features", lambda: _world_features(_checked(world.get_features()))))
            return fields
        device = body_of(robot)
        if arm is not None and "get_task_status" not in lacks(arm):
            fields.update(self._field("task_status", lambda: _status(_checked(arm.get_task_status()))))
        if arm is not None and "get_features" not in lacks(arm):
            fields.update(self._field("features", lambda: _features(_checked(arm.get_features()))))
        fields.update(self._field("connected", lambda: _typed(device, "connected", "is_connected", bool)))
        fields.update(self._field("hw", lambda: _typed(device, "hw", "hardware_name", str)))
        return fields

    def _field(self, name: str, read: Callable[[], Fields]) -> Fields:
        fields: Fields = {}
        trouble = ""
        try:
            fields = read()
        except Exception as exc:  # noqa: BLE001 - whatever a robot's read raises costs this field alone
            trouble = f"{type(exc).__name__}: {exc}"
        self._troubles.note(name, trouble, "%s is announced without its %s: %s", self._peer_id, name, trouble)
        return fields


def _checked(answer: Fields) -> Fields:
    if not isinstance(answer, Mapping):
        raise UnreadableError("malformed", f"the robot answered with a {type(answer).__name__}")
    if is_error(answer):
        raise UnreadableError("refused", text_of(dict(answer)))
    return answer


def _joints(state: Fields) -> dict[str, float]:
    joints = state.get("joints")
    good: dict[str, float] = {}
    bad: list[str] = []
    for name, value in (joints if isinstance(joints, Mapping) else {}).items():
        position = _float(value)
        if position is not None and math.isfinite(position):
            good[str(name)] = position
        else:
            bad.append(str(name))
    problem, age = state.get("joints_error"), state.get("joints_age_s")
    if problem:
        aged = _float(age)
        fresh = aged is not None and aged <= STALE_S
        raise UnreadableError("stale", str(problem), good if fresh else None)
    return _without(good, bad)


def _without(joints: dict[str, Any], bad: list[str]) -> dict[str, Any]:
    if bad:
        good = {name: entry for name, entry in joints.items() if name not in bad}
        raise UnreadableError("not a number", ", ".join(bad), good)
    return joints


def _is_number_or_none(value: object) -> bool:
    if value is None:
        return True
    found = _float(value)
    return found is not None and math.isfinite(found)


def _float(value: object) -> float | None:
    """Return a number, or an array's one element, as a float, else None."""
    plain = value if type(value) is float else plain_scalar(value)
    while plain is not value and isinstance(plain, list) and len(plain) == 1:
        plain = plain[0]
    return float(plain) if isinstance(plain, int | float) and not isinstance(plain, bool) else None


def _sim_time(state: Fields) -> float | None:
    return _float(state.get("sim_time"))


def _active(names: list[str], running: list[dict[str, Any]]) -> dict[str, bool]:
    moving = {str(row.get("robot", "")) for row in running}
    return {name: name in moving for name in names}


def _task(status: Fields) -> Fields:
    return {name: status[field] for name, field in TASK_FIELDS.items() if field in status}


def _world_task(running: list[dict[str, Any]]) -> Fields:
    if not running:
        return {}
    first = running[0]
    return {
        "status": "running",
        "instruction": first.get("instruction", ""),
        "steps": first.get("step", 0),
        "duration": first.get("elapsed_s", 0.0),
    }


def _status(status: Fields) -> Fields:
    fields = {"task_status": str(status.get("task_status", "idle"))}
    return fields | ({"instruction": str(status["instruction"])} if status.get("instruction") else {})


def _world_status(running: list[dict[str, Any]]) -> Fields:
    if not running:
        return {"task_status": "idle"}
    return {"task_status": "running", "instruction": str(running[0].get("instruction", ""))}


def _features(features: Fields) -> Fields:
    fields: dict[str, Any] = {}
    actions, observations = features.get("action_features"), features.get("observation_features")
    if isinstance(actions, Mapping):
        fields["action_keys"] = sorted(str(key) for key in actions)[:KEYS_MAX]
    if isinstance(observations, Mapping):
        images = [
            str(key)
            for key, shape in observations.items()
            if isinstance(shape, list | tuple) and len(shape) == IMAGE_DIMENSIONS
        ]
        if images:
            fields["cameras"] = images[:KEYS_MAX]
    return fields


def _world_features(features: Fields) -> Fields:
    fields: dict[str, Any] = {}
    robots, cameras = features.get("robots"), features.get("cameras")
    if isinstance(robots, Mapping) and robots:
        fields["action_keys"] = sorted(
            str(key) if len(robots) == 1 else f"{name}/{key}"
            for name, each in robots.items()
            for key in each.get("action_features", ())
        )[:KEYS_MAX]
    if cameras:
        # The wire's camera names hold no slash.
        fields["cameras"] = [str(name).replace("/", ".") for name in cameras][:KEYS_MAX]
    return fields


def _typed(device: Any, field: str, name: str, kind: type) -> Fields:
    value = plain_scalar(getattr(device, name, None))
    return {field: value} if isinstance(value, kind) and value != "" else {}


IDLE_HZ = 1.1
"""States a second of a robot that does nothing: at least one, even where one is a little late."""

LOOK_HZ = 10.0
"""Looks a second for a change of the lockouts, which nothing else tells."""

ACTIVE_S = 1.0
"""Seconds after the last sign of a motion in which the state is published as if the robot moved."""

STILL = 1e-3
"""Change of a joint, in its own unit, up to which it stands still: noise, and the settling of a simulation."""


class StateRate:
    """Signs of a robot's motion: its gate, lockouts and last states; any thread.

    Args:
        gate: every motion asks it for a permit before it begins.
        epochs: returns the lockouts of the robot.
        hurry: has the state published at once.
    """

    def __init__(
        self,
        gate: MotionGate,
        epochs: Callable[[], object],
        hurry: Callable[[], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._gate = gate
        self._epochs = epochs
        self._hurry = hurry
        self._clock = clock
        self._seen_halts, self._seen_given = self._halts(), gate.given
        self._active_until = -math.inf
        self._joints: dict[str, float] = {}

    @property
    def active(self) -> bool:
        """True while the robot moves, and shortly after."""
        return self._clock() < self._active_until

    def begins(self) -> None:
        """Publish at once for the first motion after a rest; called before each permit."""
        now = self._clock()
        if now >= self._active_until:
            self._active_until = now + ACTIVE_S
            self._hurry()

    def look(self) -> None:
        """Publish at once after a halt or a change of the lockouts."""
        halts, given = self._halts(), self._gate.given
        if halts != self._seen_halts:
            self._seen_halts = halts
            self._active_until = self._clock() + ACTIVE_S
            self._hurry()
        if given != self._seen_given:
            self._seen_given = given
            self._active_until = self._clock() + ACTIVE_S

    def published(self, body: Mapping[str, Any]) -> None:
        """Note a state: it tells whether a task runs and whether joints have moved."""
        joints = dict(_positions(body.get("joints")))
        moved = joints.keys() != self._joints.keys() or any(
            abs(at - self._joints[name]) > STILL for name, at in joints.items()
        )
        if moved:
            # Compared with the last that counted as moved, so that a slow motion adds up.
            self._joints = joints
        task, robots = body.get("task"), body.get("robots")
        runs = isinstance(task, Mapping) and task.get("status") in RUNNING
        if moved or runs or (isinstance(robots, Mapping) and any(robots.values())):
            self._active_until = self._clock() + ACTIVE_S

    def _halts(self) -> object:
        return self._gate.generation, self._epochs()


class StateRates:
    """The rates of a process, looked at by one job for all of its robots."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._rates: tuple[StateRate, ...] = ()
        self._end: Callable[[], None] | None = None

    def join(self, rate: StateRate) -> None:
        """Look at ``rate`` from now on."""
        with self._lock:
            self._rates = (*self._rates, rate)
            if self._end is None:
                self._end = repeat("states", LOOK_HZ, self._look)

    def leave(self, rate: StateRate) -> None:
        """Look at ``rate`` no more."""
        with self._lock:
            self._rates = tuple(each for each in self._rates if each is not rate)
            end, self._end = (None, self._end) if self._rates else (self._end, None)
        if end is not None:
            end()

    def _look(self) -> None:
        for rate in self._rates:
            rate.look()


STATE_RATES = StateRates()
"""The rates of this process."""


def _positions(joints: object) -> list[tuple[str, float]]:
    found = []
    for name, entry in joints.items() if isinstance(joints, Mapping) else ():
        at = entry.get("position") if isinstance(entry, Mapping) else entry
        if (position := _float(at)) is not None:
            found.append((str(name), position))
    return found


ARRAY_MAX = 100
WAITING = 8


MOTION_REFUSED = "motion_refused"
"""Safety event of a motion that was refused while the robot is locked."""


class StepPublisher:
    """Publishes turns and policy steps, of rollouts and of programs.

    A rollout reports on its control thread, so its messages leave on a thread of this publisher's own; where the
    transport is slower than the rollout the oldest are dropped.

    Args:
        hz: steps a second of each robot at most; 0 or less is none at all.
    """

    def __init__(self, context: Context, robot: Any, hz: float) -> None:
        self._context = context
        self._robot = robot
        self._handed_in = RateLimiter(hz)
        self._rollouts = RateLimiter(hz)
        self._executor = BoundedExecutor(f"{context.peer_id}-stream", WAITING)
        self._unsubscribe: Unsubscribe | None = None
        self._unwatch: Unsubscribe = lambda: None
        self._unpublished = 0

    def start(self) -> None:
        """Subscribe to the robot's rollouts, if it can, and to its refusals."""
        if self._robot is None:
            return
        self._unwatch = gate_of(body_of(self._robot)).watch_refusals(self.on_refused)
        try:
            self._unsubscribe = self._robot.subscribe(self.on_event)
        except Exception as exc:  # noqa: BLE001 - a foreign robot's subscribe may be something else altogether
            logger.warning(
                "%s: its rollouts cannot be subscribed to, so no steps are published: %s", self._context.peer_id, exc
            )

    def stop(self, timeout: float) -> list[str]:
        """Unsubscribe; names of threads that still publish after ``timeout`` seconds."""
        self._unwatch()
        unsubscribe, self._unsubscribe = self._unsubscribe, None
        if callable(unsubscribe):
            unsubscribe()
        return self._executor.stop(timeout)

    def on_event(self, event: object) -> None:
        """Take a rollout event, on its control thread; returns at once."""
        if not isinstance(event, RolloutEvent):
            return
        if event.kind == "started":
            self._rollouts.forget(event.robot)
        if event.kind == "step" and self._context.running() and self._rollouts.admit(event.robot):
            stamp = self._context.clock()

            def publish() -> None:
                several = len(robots_in(self._robot)) > 1
                prefix = f"{event.robot}/" if several else ""
                observation = {prefix + key: value for key, value in event.observation.items()}
                action = {prefix + key: value for key, value in event.action.items()}
                about = {"instruction": event.instruction, "policy": event.policy}
                led = {"led_by": event.led_by} if event.led_by else {}
                named = {"robot_name": event.robot} if several else {}
                self._put(stamp, event.step, observation, action, **about, **led, **named)

            self._executor.submit(publish)
        elif event.kind == "turn":
            peer, stamp = self._context.peer_id, self._context.clock()
            body = {"peer_id": peer, "t": stamp, "state": event.state, "leader": event.led_by, "why": event.error}
            named = {"robot_name": event.robot} if holds_robots(self._robot) else {}
            self._executor.submit(partial(self._send, topics.turn(peer), {**body, **named}))

    def on_refused(self, verb: str, why: str) -> None:
        """Publish that a motion was refused while locked; return at once.

        As of every safety event its reason is a code; the truth is in the local audit.
        """
        peer, stamp = self._context.peer_id, self._context.clock()
        body = {"peer_id": peer, "t": stamp, "event": MOTION_REFUSED, "severity": "info", "reason": MOTION_REFUSED}
        self._executor.submit(partial(self._send, topics.safety_event(peer), {**body, "verb": verb}))

    def publish(
        self, step: int, observation: Mapping[str, Any], action: Mapping[str, Any], instruction: str, policy: str
    ) -> None:
        """Publish one step in the calling thread; one above the rate is left out."""
        if self._context.running() and self._handed_in.admit():
            self._put(self._context.clock(), step, observation, action, instruction=instruction, policy=policy)

    def _put(
        self,
        now: float,
        step: int,
        observation: Mapping[str, Any],
        action: Mapping[str, Any],
        **about: str,
    ) -> None:
        peer = self._context.peer_id
        body = {
            "peer_id": peer,
            "step": step,
            "t": now,
            **about,
            "observation": numbers(observation),
            "action": numbers(action),
        }
        self._send(topics.stream(peer), body)

    def _send(self, topic: str, body: Mapping[str, Any]) -> None:
        try:
            self._context.put(topic, body)
        except (TransportError, WireError) as exc:
            self._unpublished += 1
            # A link that is down must not fill the log at the rate of a rollout.
            if self._unpublished & (self._unpublished - 1) == 0:
                logger.warning("%s: %d messages were not published: %s", self._context.peer_id, self._unpublished, exc)
        else:
            self._unpublished = 0


def numbers(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the numbers, booleans and 1-D arrays under 100 entries."""
    plain = {str(key): _plain(value) for key, value in values.items()}
    return {key: value for key, value in plain.items() if value is not None}


def _plain(value: Any) -> Any:
    if isinstance(value, bool):
        return value
    if isinstance(value, int | float):
        return value if math.isfinite(value) else None
    if hasattr(value, "tolist") and getattr(value, "ndim", 2) <= 1:
        value = value.tolist()
        if not isinstance(value, list):
            return _plain(value)
    if isinstance(value, list | tuple) and len(value) < ARRAY_MAX:
        entries = [_plain(entry) for entry in value if not isinstance(entry, list | tuple)]
        return entries if len(entries) == len(value) and None not in entries else None
    return None
