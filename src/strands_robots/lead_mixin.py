"""Leading of any robot from elsewhere, command by command."""

from __future__ import annotations

import math
import time
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import Any, NamedTuple

from strands_robots.envelope import Envelope, error, success
from strands_robots.policies.base import Policy
from strands_robots.policies.handover import GUIDES, LEAD_S, PICTURE_MAX_MS, Guide, Lead, LeaderCommand, LedPolicy
from strands_robots.policies.rollout import START_S, Body, Rollout
from strands_robots.policies.task_engine import NewTask, TaskEngine
from strands_robots.safety.gate import MotionRequest, Permit, answered
from strands_robots.teleoperators import FULL_RANGES_PER_S, LeaderPolicy
from strands_robots.utils import ValidationError, choice, identifier, number
from strands_robots.utils import duration as checked_duration


class PolicyChoice(NamedTuple):
    """Policy of a lead: its provider, task and options."""

    provider: str
    instruction: str
    options: dict[str, Any]


SESSIONS_MAX = 64
"""Last sessions of leaders that are kept; those of leaders elsewhere make room."""


class LeadMixin:
    """Verbs by which a leader elsewhere drives a body.

    It leads alone, or in turns with a policy. A lead is a task of the host's engine, and ends with its halts.
    """

    tasks: TaskEngine

    @abstractmethod
    def body(self, robot_name: str | None = None) -> Body:
        """Return the body of that name, or the first; raises :class:`ValidationError`."""

    @answered
    def lead(
        self,
        leader: str = "leader",
        *,
        duration: float = LEAD_S,
        guide: Guide = "positions",
        stale_ms: float = PICTURE_MAX_MS,
        policy_provider: str = "",
        instruction: str = "",
        max_speed: float = FULL_RANGES_PER_S,
        robot_name: str = "",
        spare_s: float | None = None,
        request: MotionRequest | None = None,
        **policy: Any,
    ) -> Envelope:
        """Let a leader elsewhere drive a body by :meth:`lead_to`, and return at once.

        Args:
            leader: its name.
            duration: seconds, above 0 up to a day.
            guide: ``positions``, or ``differences`` from the beginning of each turn of the leader.
            stale_ms: greatest age of the operator's newest picture, 20 to 10000.
            policy_provider: policy that drives until the leader takes over; empty for none.
            instruction: the policy's task, 1 to 2000 characters.
            max_speed: whole joint ranges a second that the follower may cross, above 0, at most 20.
            robot_name: body to drive; empty for the first.
            spare_s: seconds that a command may be older than its link's shortest way; 0.1 by default.
            request: what it begins for; made now by default.
            policy: what that policy's constructor takes besides.
        """
        name, rate = identifier("leader", leader), self.tasks.rate()
        far_s = number("stale_ms", stale_ms, low=20, high=10_000) / 1000
        lead = Lead(name, policy=bool(policy_provider), picture_max_s=far_s, spare_s=spare_s)
        meant = choice("guide", guide, GUIDES)
        fastest = number("max_speed", max_speed, above=0, high=20)

        def driver(inner: Policy | None) -> LedPolicy:
            made = LedPolicy(lead, inner, guide=meant, max_speed=fastest, period=1 / rate)
            self._teleop_policies[name] = made
            return made

        new = self._new_lead(driver, name, duration, PolicyChoice(policy_provider, instruction, policy))
        body = self.body(robot_name or None)
        if name in self.tasks.leading():
            led = self.tasks.by_leader[name].robot
            raise ValidationError(f"leader must be another than {name!r}, which leads {led} now.")
        session = self.tasks.start("lead", body.name, new, request, leader=name)
        problem = session.not_begun()
        if problem:
            return error(f"lead: {problem}.")
        # The leader begins from where the robot is.
        lead.seen.wait(START_S)
        self._leads[lead.id] = lead
        self._forget(ended=[each for each in list(self._leads.values()) if each.state == "over"])
        return success(
            f"{name} leads {body.name}.",
            lead_id=lead.id,
            leader=name,
            robot=body.name,
            hz=rate,
            # JSON has no infinity.
            ranges={
                key: [bound if math.isfinite(bound) else None for bound in pair] for key, pair in body.bounds.items()
            },
            **lead.facts(),
        )

    @answered
    def lead_to(
        self,
        lead_id: str,
        seq: int,
        *,
        turn: int = 1,
        leads: bool = True,
        targets: Mapping[str, float] | None = None,
        made: float = 0.0,
        told: float = 0.0,
        told_ago: float = 0.0,
        picture_age_ms: float | None = None,
        end: bool = False,
    ) -> Envelope:
        """Take a command; answer at once with what the last step wrote.

        Args:
            lead_id: as :meth:`lead` returned it.
            seq: number of the command, each greater than the one before.
            turn: number of the turn; a greater one than before takes over, or gives back.
            leads: False in a turn that is left to the policy.
            targets: by action key, in the robot's units.
            made: the leader's clock at the command's making, in seconds.
            told: ``now`` of the last answer that the leader has, the robot's clock.
            told_ago: seconds between that answer and the command's making.
            picture_age_ms: age of the newest picture that the operator saw; None where it drives without.
            end: end the lead; the robot holds.
        """
        received = time.monotonic()
        lead = self._leads.get(lead_id)
        if lead is None:
            raise ValidationError("lead_id must be that of a lead of this robot, and this is none.")
        if end:
            lead.end("")
        else:
            age = None if picture_age_ms is None else picture_age_ms / 1000
            lead.take(LeaderCommand(seq, turn, leads, targets or {}, made, told, told_ago, age), received)
        session = self.tasks.by_leader.get(lead.leader)
        if not end and (session is None or session.voided or not session.running):
            failed = lead.why or (session.error if session is not None else "")
            # A lead that has completed was not stopped, though its permit is void.
            halted = session is not None and (session.state == "stopped" or (session.running and session.voided))
            completed = session is not None and session.state == "completed" and not failed
            why = failed or ("its policy is done, or its time" if completed else "it was stopped")
            facts = {**lead.facts(), "state": "over", "halted": halted, "completed": completed}
            return error(f"The lead of {lead.leader} is over: {why}.", **facts)
        return success(f"{lead.leader}: {lead.state}.", **lead.facts())

    def _forget(self, *, ended: Sequence[Lead]) -> None:
        """Forget leads that are over, and their sessions where there are many."""
        for lead in ended:
            self._leads.pop(lead.id, None)
            session = self.tasks.by_leader.get(lead.leader)
            if session is not None and not session.running and len(self._teleop_policies) > SESSIONS_MAX:
                # A reader of the sessions has them before it looks for their policies.
                self.tasks.by_leader.pop(lead.leader, None)
                self._teleop_policies.pop(lead.leader, None)

    @cached_property
    def _leads(self) -> dict[str, Lead]:
        return {}

    @cached_property
    def _teleop_policies(self) -> dict[str, LeaderPolicy | LedPolicy]:
        return {}

    def _new_lead(
        self, driver: Callable[[Policy | None], Policy], leader: str, duration_s: float, policy: PolicyChoice
    ) -> NewTask:
        """Check the policy of a lead, and return the task that the lead is."""
        seconds = checked_duration("duration", duration_s)
        if policy.provider:
            return self.tasks.of_policy(policy.instruction, policy.provider, seconds, policy.options, driver)
        given = ["instruction"] * bool(policy.instruction) + sorted(policy.options)
        if given:
            raise ValidationError(f"policy_provider must name the policy that {', '.join(given)} is for.")

        def make(body: Body, permit: Permit, _: object) -> Rollout:
            return Rollout(
                body,
                driver(None),
                permit=permit,
                instruction=f"follow {leader}",
                policy_name="teleoperation",
                duration=seconds,
                hz=self.tasks.rate(),
                observers=self.tasks.observers,
            )

        return NewTask(make)
