"""Rollouts of the robots of a world: one at a time for each robot, all of them ended by a halt."""

from __future__ import annotations

import logging
from collections.abc import Callable
from functools import partial
from typing import Any

from strands_robots import settings
from strands_robots.contract import Observer, Unsubscribe
from strands_robots.envelope import Envelope, error, success
from strands_robots.policies.registry import create_policy
from strands_robots.policies.rollout import STOP_JOIN_S, Rollout, RolloutObservers, rollout_options
from strands_robots.safety.gate import Waiting
from strands_robots.simulation.arguments import answered
from strands_robots.simulation.body import RobotBody
from strands_robots.simulation.pictures import Pictures
from strands_robots.simulation.stage import Plan
from strands_robots.teleop_mixin import TeleopMixin
from strands_robots.utils import MissingExtraError, ValidationError

logger = logging.getLogger(__name__)

TEARDOWN_S = 5.0
"""How much longer than its duration :meth:`Rollouts.run_policy` waits for a rollout to end."""


class Rollouts(Pictures, TeleopMixin):
    """The verbs that start, watch and stop rollouts; those of teleoperation come with the mixin."""

    def __init__(self, plan: Plan, *, realtime: bool) -> None:
        super().__init__(plan, realtime=realtime)
        self.observers = RolloutObservers()
        self._rollouts: dict[str, Rollout] = {}
        self._waiting = Waiting()

    def subscribe(self, observer: Observer) -> Unsubscribe:
        """Tell ``observer`` of every rollout event until the returned callable is called."""
        return self.observers.subscribe(observer)

    @answered
    def start_policy(
        self,
        robot_name: str,
        instruction: str,
        policy_provider: str = "mock",
        duration: float = 30.0,
        **policy: Any,
    ) -> Envelope:
        """Start a rollout of one robot and return at once.

        Args:
            robot_name: a robot of this world; empty for the first.
            instruction: what it shall do, 1 to 2000 characters.
            policy_provider: a registered policy, such as mock.
            duration: seconds, above 0 up to a day.
            policy: what that policy's constructor takes; besides, ``control_frequency`` (Hz, at most the robot's rate)
                and ``n_steps`` (actions after which it ends).
        """
        rollout = self._start_rollout(robot_name, instruction, policy_provider, duration, policy)
        return success(
            f"{rollout.robot} started: {rollout.instruction}",
            robot=rollout.robot,
            instruction=rollout.instruction,
            policy_provider=rollout.policy_name,
            duration=rollout.duration,
        )

    @answered
    def run_policy(
        self,
        robot_name: str,
        instruction: str,
        policy_provider: str = "mock",
        duration: float = 30.0,
        **policy: Any,
    ) -> Envelope:
        """The same, but wait for the end; an error when the policy failed or did not end in its time."""
        rollout = self._start_rollout(robot_name, instruction, policy_provider, duration, policy)
        if not rollout.join((rollout.duration or 0.0) + TEARDOWN_S):
            _ask(rollout)
            return error(f"{rollout.robot} was still running {TEARDOWN_S:g} s after its time.", **self._row(rollout))
        if rollout.state == "error":
            return error(f"{rollout.robot} failed: {rollout.error}", **self._row(rollout))
        return success(f"{rollout.robot} {rollout.state} after {rollout.step_count} steps.", **self._row(rollout))

    @answered
    def stop_policy(self, robot_name: str) -> Envelope:
        """Stop what drives one robot, a policy or a leader, and freeze the robot where it is.

        ``stopped`` is false if the loop outlived it. A policy or a leader that is still made ready never begins, and
        targets that a single action has set are given up.
        """
        body = self.body(robot_name)
        self._waiting.void(body.name)
        self.void_leaders(body.name)
        rollout = self._running().get(body.name) or self.teleoperating().get(self.teleoperated_by(body.name))
        if rollout is None:
            # A single action goes on by itself: the servos run to its targets.
            body.hold()
            return success(f"{body.name} ran no policy; it is held.", robot=body.name, stopped=True, was_running=False)
        return self._stop(body, rollout, STOP_JOIN_S)

    def list_policies_running(self) -> list[dict[str, Any]]:
        """One row a running rollout: robot, instruction, policy, step, elapsed_s."""
        return [rollout.row() for rollout in self._running().values()]

    def policy_status(self, robot_name: str | None = None) -> dict[str, Any]:
        """The row of a robot's present or last rollout, with state and error; empty when there was none."""
        rollout = self._rollouts.get(self.body(robot_name).name)
        return {} if rollout is None else self._row(rollout)

    def moving(self) -> list[str]:
        leaders = [f"{leader} leading {session.robot}" for leader, session in self.teleoperating().items()]
        return [f"policy on {name}" for name in self._running()] + leaders

    def occupied(self, robot: str) -> str:
        """What rollout drives the robot of that name now, for a refusal; empty when none does."""
        rollout = self._running().get(robot)
        return "" if rollout is None else f"the policy {rollout.policy_name} ({rollout.instruction!r})"

    def _start_rollout(
        self, robot_name: str, instruction: str, provider: str, duration: float, options: dict[str, Any]
    ) -> Rollout:
        chosen = rollout_options(instruction, duration, options, settings.number("STRANDS_CONTROL_HZ"))
        permit = self.gate.permit("start_policy")
        with self._waiting.until_begun(permit, self.body(robot_name).name):
            try:
                policy = create_policy(provider, **options)
            except MissingExtraError as missing:
                raise ValidationError(str(missing)) from missing
            with self.starting:
                self._open()
                body = self.body(robot_name)
                self._idle(body.name)
                if not permit.valid:
                    raise ValidationError(f"start_policy: {body.name} was halted while its policy was made ready.")
                rollout = Rollout(
                    body,
                    policy,
                    permit=permit,
                    policy_name=provider,
                    observers=self.observers,
                    **chosen,
                )
                self._rollouts[body.name] = rollout
                rollout.start()
                return rollout

    def _idle(self, name: str) -> None:
        driver = self.occupied(name) or self.teleoperated_by(name)
        if driver:
            raise ValidationError(f"{name} is driven by {driver}; stop that first.")

    def _running(self) -> dict[str, Rollout]:
        return {name: rollout for name, rollout in list(self._rollouts.items()) if rollout.running}

    @staticmethod
    def _row(rollout: Rollout) -> dict[str, Any]:
        return {**rollout.row(), "state": rollout.state, "error": rollout.error}

    def _stop(self, body: RobotBody, rollout: Rollout, patience_s: float) -> Envelope:
        _ask(rollout)
        body.hold()
        stopped = rollout.join(patience_s)
        row = {**self._row(rollout), "stopped": stopped, "was_running": True}
        if not stopped:
            policy = rollout.policy_name
            return error(f"{body.name} is frozen, but its policy {policy} has not returned yet.", **row)
        return success(f"{body.name} stopped after {rollout.step_count} steps.", **row)

    def _stops(self, deadline: float) -> dict[str, Callable[[], object]]:
        """Ask every rollout to end at once; how to wait for each, until ``deadline`` on the monotonic clock."""
        running = self._running()
        for rollout in running.values():
            _ask(rollout)
        waits = {name: partial(rollout.ended_by, deadline) for name, rollout in running.items()}
        return {**waits, **self.teleop_stops(deadline)}


def _ask(rollout: Rollout) -> None:
    """Ask it to end. Its leave is void before its policy is told, so one that raises there has lost it all the same."""
    try:
        rollout.request_stop()
    except Exception:
        logger.exception("The policy %s of %s raised when it was interrupted.", rollout.policy_name, rollout.robot)
