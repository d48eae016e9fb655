"""Teleoperation for any robot: a leader drives a body through a rollout."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

from strands_robots.envelope import Envelope, error, success
from strands_robots.lead_mixin import LeadMixin
from strands_robots.leader_thread import LeaderThread
from strands_robots.moved import of_module
from strands_robots.policies.rollout import STOP_JOIN_S, Body, Rollout
from strands_robots.policies.task_engine import NewTask
from strands_robots.safety.gate import Permit, answered
from strands_robots.teleoperators import FULL_RANGES_PER_S, GIVE_UP_S, InputSink, LeaderPolicy
from strands_robots.utils import ValidationError, choice, flag, identifier, number, teleoperator_contract_error

if not TYPE_CHECKING:
    __path__, __getattr__ = of_module(__name__)


METHODS = ("arm", "gamepad", "keyboard", "phone")


class TeleopMixin(LeadMixin):
    """Verbs of teleoperation for a host that has the members declared here.

    One source drives a body at a time; a session is a task of the host's engine, and ends with its halts.
    """

    input_sink: InputSink | None = None
    """Receiver of published frames; a network that carries input streams sets it."""

    def occupied(self, robot: str) -> str:
        """Name the task that drives the body of that name, for a refusal; empty for none."""
        return self.tasks.occupied(robot)

    @answered
    def attach_teleop(
        self,
        leader: Any,
        name: str = "leader",
        *,
        robot_name: str | None = None,
        keys: Mapping[str, str] | None = None,
        method: str = "arm",
        max_speed: float = FULL_RANGES_PER_S,
    ) -> Envelope:
        """Bind a leader to a body, in place of an earlier one of that name.

        Args:
            leader: an object with ``get_action()``, connected.
            name: the leader's name here and on the network.
            robot_name: body to drive; the first where the host has several and none is named.
            keys: follower's action key for each leader's key that differs.
            method: arm, gamepad, keyboard or phone.
            max_speed: whole joint ranges a second that the follower may cross, above 0, at most 20.
        """
        reason = teleoperator_contract_error(leader)
        if reason is not None:
            return error(reason)
        robot = self.body(robot_name).name
        policy = partial(
            LeaderPolicy,
            leader,
            device=identifier("name", name),
            method=choice("method", method, METHODS),
            keys=dict(keys or {}),
            max_speed=number("max_speed", max_speed, above=0, high=20),
        )
        with self.tasks.starting:
            if name in self.teleoperating():
                return error(f"{name} teleoperates {self.tasks.by_leader[name].robot} now; stop_teleoperate it first.")
            self._teleop_leaders[name] = (robot, policy)
        return success(f"{name} will lead {robot}.", name=name, robot=robot)

    @answered
    def teleoperate(
        self,
        name: str = "leader",
        duration: float | None = None,
        hz: float = 50.0,
        publish: bool = False,
    ) -> Envelope:
        """Let an attached leader drive its body, and return at once.

        Args:
            name: as attached.
            duration: seconds, above 0, at most 3600; None until stopped.
            hz: frames a second, 1 to 1000.
            publish: also carry the leader's frames on the network.
        """
        seconds = None if duration is None else number("duration", duration, above=0, high=3600)
        rate = number("hz", hz, low=1, high=1000)
        if flag("publish", publish) and self.input_sink is None:
            raise ValidationError("publish must be false: no network that carries input streams is attached.")
        session = self._lead(identifier("name", name), seconds, rate, self.input_sink if publish else None)
        return success(f"{name} leads {session.robot}.", name=name, robot=session.robot, hz=rate)

    def stop_teleoperate(self, name: str | None = None, timeout: float = STOP_JOIN_S) -> Envelope:
        """Stop one leader or all; ``stopped`` is false after ``timeout`` seconds."""
        self.tasks.waiting_leaders.void(name)
        running = self.teleoperating()
        stopping = running if name is None else {key: each for key, each in running.items() if key == name}
        if not stopping:
            return success("No leader is running.", stopped=True, was_running=False)
        deadline = time.monotonic() + timeout
        for session in stopping.values():
            session.request_stop()
        late = [key for key, each in stopping.items() if not each.join(max(0.0, deadline - time.monotonic()))]
        fields = {"stopped": not late, "was_running": True, "leaders": self._teleop_rows(stopping)}
        if late:
            return error(
                f"{', '.join(late)}: the loop still waits for its leader; it sends no action any more.", **fields
            )
        return success(f"Stopped {', '.join(stopping)}.", **fields)

    def teleop_status(self) -> Envelope:
        """Answer with one row for each leader that leads or has led."""
        rows = self._teleop_rows(dict(self.tasks.by_leader))
        return success(f"{len(self.teleoperating())} leaders lead.", running=list(self.teleoperating()), leaders=rows)

    def teleoperating(self) -> dict[str, Rollout]:
        """Return the running sessions by leader."""
        return self.tasks.leading()

    def teleoperated_by(self, robot: str) -> str:
        """Return the leader that drives the body of that name; empty when none does."""
        return self.tasks.leader_of(robot)

    def void_leaders(self, robot: str) -> None:
        """Void the waiting starts of all leaders of the body of that name."""
        for name, (led, _) in list(self._teleop_leaders.items()):
            if led == robot:
                self.tasks.waiting_leaders.void(name)

    @cached_property
    def _teleop_leaders(self) -> dict[str, tuple[str, Callable[..., LeaderPolicy]]]:
        return {}

    def _lead(self, name: str, seconds: float | None, rate: float, sink: InputSink | None) -> Rollout:
        if name not in self._teleop_leaders:
            known = ", ".join(self._teleop_leaders) or "none yet"
            raise ValidationError(f"name must be an attached leader ({known}), not {name!r}; attach_teleop it first.")
        robot, make_policy = attached = self._teleop_leaders[name]

        def make(body: Body, permit: Permit, _: object) -> Rollout:
            if self._teleop_leaders[name] is not attached:
                raise ValidationError(f"{name} was attached anew while it waited for {robot}; teleoperate it again.")
            # A leader that hangs must hold up no stop, and no base that it has set moving.
            thread = LeaderThread(name, GIVE_UP_S)
            policy = self._teleop_policies[name] = make_policy(period=1 / rate, sink=sink, thread=thread)
            return Rollout(
                body,
                policy,
                permit=permit,
                instruction=f"follow {name}",
                policy_name="teleoperation",
                duration=seconds,
                hz=rate,
                observers=self.tasks.observers,
            )

        return self.tasks.start("teleoperate", robot, NewTask(make), leader=name)

    def _teleop_rows(self, sessions: Mapping[str, Rollout]) -> dict[str, dict[str, Any]]:
        rows = {}
        for name, rollout in sessions.items():
            policy = self._teleop_policies.get(name)
            if policy is None:
                continue
            rows[name] = {
                **rollout.row(),
                "state": rollout.state,
                "error": rollout.error or policy.last_error,
                "frames": policy.frames,
                "errors": policy.errors,
                "event_read_errors": policy.event_errors,
                "hz_actual": round(rollout.step_count / rollout.elapsed_s, 2) if rollout.elapsed_s > 0 else 0.0,
            }
        return rows
