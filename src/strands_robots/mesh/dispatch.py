"""A validated command carried out on the robot of this process, whatever its kind."""

from __future__ import annotations

import inspect
import logging
import time
from collections.abc import Callable
from typing import Any

from strands_robots.bus_access import read_joints
from strands_robots.contract import RUNNING, RolloutEvent, TaskRobot, WorldRobot, adapt
from strands_robots.envelope import Envelope, error, is_error, success
from strands_robots.mesh.security import policy_host_refusal
from strands_robots.safety.stopping import StopVerdict, verdict_of

logger = logging.getLogger(__name__)

POLL_S = 0.05
EXECUTE_GRACE_S = 10.0
TOLD_S = 0.5
HALT = "stop over the mesh"
POLICY_FIELDS = (
    "policy_port",
    "policy_host",
    "pretrained_name_or_path",
    "control_frequency",
    "action_horizon",
    "n_steps",
    "target_pose",
    "target_joints",
    "target_velocity",
)

Robot = TaskRobot | WorldRobot


def fit(robot: Any) -> Robot | None:
    """The robot behind its contract; None for a peer without one.

    Raises:
        ValidationError: an object that is no robot.
    """
    if robot is None:
        return None
    return robot if isinstance(robot, WorldRobot) else adapt(robot, read_joints)


class Dispatcher:
    """Carries out the actions that reach the robot.

    Args:
        robot: None answers every action that needs one with an error, and stop with "nothing to halt".
        halt: how this peer's robot is halted, every motion source of it.
        wall: sleeps between two looks at a rollout; for tests.
    """

    def __init__(self, robot: Robot | None, halt: Callable[[str], StopVerdict], closing: Callable[[], bool]) -> None:
        self._robot = robot
        self._halt = halt
        self._closing = closing

    def __call__(self, command: dict[str, Any]) -> Any:
        """The result of ``command``, an envelope or a dict; whatever the robot raises is the caller's."""
        action = command["action"]
        if action == "stop":
            return self.stop(command.get("robot_name"))
        if self._robot is None:
            return error(f"{action}: no robot is registered on this peer.")
        verb = getattr(self, f"_{action}")
        return verb(self._robot, command)

    def stop(self, robot_name: str | None = None) -> dict[str, Any]:
        """``ok``, ``stopped`` and ``not_stopped`` (names), ``results``, and ``error`` where not everything stopped."""
        robot = self._robot
        if robot is None:
            return {"ok": True, "stopped": [], "not_stopped": [], "results": {}}
        name = self.meant(robot_name or "")
        if isinstance(name, dict):
            return name
        return told(stop_one(robot, name) if name and isinstance(robot, WorldRobot) else self._halt(HALT))

    def meant(self, robot_name: str) -> str | dict[str, Any]:
        """The robot that a stop means, empty for all there is; or the answer, where this world has none of the name."""
        world = self._robot
        if not robot_name or not isinstance(world, WorldRobot):
            return ""
        robots = world.list_robots()
        if robot_name in robots:
            return robot_name
        known = ", ".join(robots) or "none"
        return told(StopVerdict(not_stopped={robot_name: f"there is no robot of this name; there are {known}"}))

    def _status(self, robot: Robot, command: dict[str, Any]) -> Any:
        if not isinstance(robot, WorldRobot):
            return robot.get_task_status()
        running = robot.list_policies_running()
        return success(
            f"{len(running)} of {len(robot.list_robots())} robots run a policy.",
            task_status="running" if running else "idle",
            robots=robot.list_robots(),
            policies=running,
        )

    def _features(self, robot: Robot, command: dict[str, Any]) -> Any:
        return robot.get_features()

    def _state(self, robot: Robot, command: dict[str, Any]) -> Any:
        return robot.get_state()

    def _step(self, robot: Robot, command: dict[str, Any]) -> Any:
        if not isinstance(robot, WorldRobot):
            return error("step: this robot is no simulation.")
        return robot.step(command.get("steps", 1))

    def _reset(self, robot: Robot, command: dict[str, Any]) -> Any:
        return robot.reset() if isinstance(robot, WorldRobot) else error("reset: this robot is no simulation.")

    def _start(self, robot: Robot, command: dict[str, Any]) -> Any:
        refusal = policy_host_refusal(command["policy_host"])
        if refusal is not None:
            return error(refusal)
        instruction, provider = command.get("instruction", ""), command["policy_provider"]
        fields = {name: command[name] for name in POLICY_FIELDS if name in command}
        if fields.get("policy_host") == "localhost":
            del fields["policy_host"]
        if isinstance(robot, WorldRobot):
            name = _named(robot, command.get("robot_name"))
            if isinstance(name, dict):
                return name
            return robot.start_policy(
                name, instruction, policy_provider=provider, duration=command["duration"], **fields
            )
        unknown = sorted(set(fields) - _accepted(robot.start_task, fields))
        if unknown:
            return error(f"start: this robot takes no {', '.join(unknown)}.")
        return robot.start_task(instruction, policy_provider=provider, duration=command["duration"], **fields)

    def _execute(self, robot: Robot, command: dict[str, Any]) -> Any:
        name = command.get("robot_name") or (robot.list_robots() or [""])[0] if isinstance(robot, WorldRobot) else None
        ends: list[RolloutEvent] = []

        def heard(event: RolloutEvent) -> None:
            if event.kind == "finished" and name in (None, event.robot):
                ends.append(event)

        unsubscribe = robot.subscribe(heard)
        try:
            started = self._start(robot, command)
            if is_error(started):
                return started
            return self._ended(robot, name, started, ends, command["duration"])
        finally:
            unsubscribe()

    def _ended(
        self, robot: Robot, name: str | None, started: Envelope, ends: list[RolloutEvent], duration: float
    ) -> Envelope:
        deadline = time.monotonic() + duration + EXECUTE_GRACE_S
        while time.monotonic() < deadline and not ends:
            if self._closing():
                return error("execute: this peer left the mesh while the policy ran.", started=started)
            if not _moving(robot, name):
                break
            time.sleep(POLL_S)
        else:
            if not ends:
                return error("execute: the policy outlived its duration.", started=started)
        last = time.monotonic() + TOLD_S
        while not ends and not isinstance(robot, TaskRobot) and time.monotonic() < last:
            time.sleep(POLL_S)  # what runs no more has said how it ended, or is about to
        if not ends:
            return robot.get_task_status() if isinstance(robot, TaskRobot) else {**started, "state": "unknown"}
        end = ends[-1]
        facts = {"state": end.state, "task_status": end.state, "step_count": end.step, "elapsed_s": end.elapsed_s}
        if end.state == "error":
            return error(f"execute: {end.error or 'the policy failed'}", robot=end.robot, **facts)
        return success(f"{end.robot} {end.state} after {end.step} steps.", robot=end.robot, **facts)


def _moving(robot: Robot, name: str | None) -> bool:
    if isinstance(robot, WorldRobot):
        return any(row.get("robot") == name for row in robot.list_policies_running())
    return str(robot.get_task_status().get("task_status", "")).lower() in RUNNING


def stop_one(world: WorldRobot, name: str) -> StopVerdict:
    """Stop one robot of a world."""
    return verdict_of(lambda: world.stop_policy(name), name)


def told(verdict: StopVerdict) -> dict[str, Any]:
    """A verdict as the mesh's answer to ``stop``."""
    doubts = {**verdict.not_stopped, **verdict.unknown}
    result: dict[str, Any] = {
        "ok": verdict.stopped is True,
        "stopped": list(verdict.halted),
        "not_stopped": list(doubts),
        "results": {**dict.fromkeys(verdict.halted, "stopped"), **doubts},
    }
    if doubts:
        result["error"] = "; ".join(f"{name}: {why}" for name, why in doubts.items())
    return result


def _named(world: WorldRobot, name: str | None) -> str | Envelope:
    """The robot meant: the named one, or the only one; a world of several robots needs a name."""
    robots = world.list_robots()
    if name is not None:
        return name if name in robots else error(f"robot_name must be one of {', '.join(robots)}, not {name!r}.")
    if len(robots) == 1:
        return robots[0]
    return error(f"robot_name must name one of {', '.join(robots) or 'no robots'}: this world has {len(robots)}.")


def _accepted(verb: Callable[..., Any], fields: dict[str, Any]) -> set[str]:
    parameters = inspect.signature(verb).parameters
    if any(each.kind is each.VAR_KEYWORD for each in parameters.values()):
        return set(fields)
    return set(parameters)
