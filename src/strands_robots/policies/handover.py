"""A leader elsewhere that drives a robot, alone or in turns with a policy.

The leader sends commands; the control loop takes the newest of them at each beat and never waits for one. Each change
of who drives is a turn with a number of its own: the leader takes over with the next number, and gives back with the
one after it. After a hold, of whatever cause, the robot goes on only by a turn that is new.
"""

from __future__ import annotations

import math
import secrets
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from statistics import median
from typing import Any, Literal

from strands_robots.policies.base import (
    LEADER_UNBOUNDED_PER_S,
    Action,
    Counted,
    Paced,
    Policy,
    PolicyError,
    Ranges,
    Restartable,
    TurnOfDriver,
    checked_action,
    is_velocity,
    limited,
    numbers,
    speeds_across,
)
from strands_robots.policies.freshness import CommandAges
from strands_robots.utils import ValidationError, shown

State = Literal["policy", "led", "held", "over"]
"""Who drives: the policy, the leader, nobody until the next turn, and nobody any more."""

Guide = Literal["positions", "differences"]
"""How a leader's numbers are meant: as positions, or as the way since the beginning of its turn."""

GUIDES: tuple[Guide, ...] = ("positions", "differences")

LEAD_S = 3600.0
"""Longest lead, in seconds, where no other is asked for."""

PICTURE_MAX_MS = 300.0
"""Age of the operator's newest picture beyond which the robot holds."""

FIRST_S = 2.0
"""Seconds from the start in which the first command has to come."""

LOST_S = 10.0
"""Seconds of silence after which a leader gives its robot up, and a robot its leader."""


@dataclass(frozen=True)
class LeaderCommand:
    """One command of a leader.

    Attributes:
        seq: its number, each greater than the one before.
        turn: number of the turn that it belongs to.
        leads: True where the leader drives in that turn, False where it leaves it to the policy.
        action: targets by action key, in the robot's units; none for a command that only says that the leader is there.
        made: the sender's clock, in seconds.
        told: the robot's clock as the sender was told it last, in seconds.
        told_ago_s: how long ago that was when the command was made.
        picture_age_s: age of the newest picture that the operator saw; None where it drives without.
    """

    seq: int
    turn: int
    leads: bool
    action: Mapping[str, float]
    made: float
    told: float
    told_ago_s: float = 0.0
    picture_age_s: float | None = None


@dataclass
class LeadCounts:
    """Counts of a leader's commands."""

    fresh: int = 0
    stale: int = 0
    """Commands that were older than the link allows."""
    disordered: int = 0
    """Commands that came again, or after a later one."""
    unled: int = 0
    """Commands of a turn that a hold had ended."""
    holds: int = 0
    turns: int = 0


@dataclass
class Beat:
    """Orders for one control step.

    Attributes:
        begins: the first step of a turn, or of a hold.
        why: reason of a hold.
    """

    state: State
    action: Mapping[str, float] = field(default_factory=dict)
    begins: bool = False
    why: str = ""


class Lead:
    """Commands of one leader, and who drives by them. Thread-safe; no call waits.

    Args:
        leader: its name.
        policy: True where a policy drives until the leader takes over.
        picture_max_s: greatest age of the operator's newest picture.
        spare_s: as of :class:`CommandAges`.
        now: the robot's clock, in seconds.
    """

    def __init__(
        self,
        leader: str,
        *,
        policy: bool = False,
        picture_max_s: float = 0.3,
        spare_s: float | None = None,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self.leader = leader
        self.id = secrets.token_hex(16)
        """The secret that each command brings."""
        self.counts = LeadCounts()
        self.why = "" if policy else f"{leader} has not taken it over yet"
        self.seen = threading.Event()
        """Set once a control step has read the robot."""
        self._now = now
        self._ages = CommandAges(spare_s)
        self._lock = threading.Lock()
        self._picture_max_s = picture_max_s
        self._of_policy = policy
        self._state: State = "policy" if policy else "held"
        self._begins = False
        self._action: dict[str, float] = {}
        self._turn = self._seq = 0
        self._fresh_at: float | None = None
        self._began: float | None = None
        self._written: dict[str, float] = {}
        self._joints: dict[str, float] = {}

    @property
    def state(self) -> State:
        """Driver of the present control step."""
        return self._state

    def take(self, command: LeaderCommand, received: float) -> None:
        """Take a command that arrived at ``received``, if it is fresh and the newest."""
        with self._lock:
            if command.seq <= self._seq:
                # It was made before one that has come, and is no measure of the link.
                self.counts.disordered += 1
                return
            self._seq = command.seq
            age = self._ages.age_s(command.made, received, command.told, command.told_ago_s)
            if age > self._ages.limit_s:
                self.counts.stale += 1
                return
            self.counts.fresh += 1
            silent = self._silent(received)
            self._fresh_at = received
            if silent > self._ages.limit_s and (self._turn or self._of_policy):
                # A turn that was begun in the silence was begun by somebody who had not seen the hold.
                self._turn = max(self._turn, command.turn)
                self._hold(self._silence(silent))
            self._judge(command, age)

    def _silent(self, now: float) -> float:
        """Return the seconds since the newest fresh command, 0 before the first."""
        return 0.0 if self._fresh_at is None else now - self._fresh_at

    def _silence(self, silent_s: float) -> str:
        return f"no fresh command of {self.leader} has come for {1000 * silent_s:.0f} ms"

    def _judge(self, command: LeaderCommand, age: float) -> None:
        if self._state == "over":
            return
        pictured = command.picture_age_s
        if pictured is not None and pictured + age > self._picture_max_s + self._ages.one_way_s:
            self._turn = max(self._turn, command.turn)
            self._hold(f"the newest picture of {self.leader} is {1000 * pictured:.0f} ms old")
            return
        if command.turn > self._turn:
            self._begin(command)
        elif command.turn == self._turn and command.leads and self._state == "led":
            self._action = {**self._action, **command.action}
        elif command.leads:
            self.counts.unled += 1

    def _begin(self, command: LeaderCommand) -> None:
        if command.leads and not command.action:
            return
        self._turn = command.turn
        if not command.leads and not self._of_policy:
            self._hold(f"{self.leader} has let go")
            return
        self.counts.turns += 1
        self._state, self.why, self._begins = "led" if command.leads else "policy", "", True
        self._action = dict(command.action)

    def _hold(self, why: str) -> None:
        if self._state in ("led", "policy"):
            self._state, self.why, self._begins = "held", why, True
            self.counts.holds += 1

    def hold(self, why: str) -> None:
        """Hold the robot until the next turn."""
        with self._lock:
            self._hold(why)

    def is_still(self, state: State) -> bool:
        """Return True where nothing has changed since a control step began in that state."""
        with self._lock:
            if self._state != "over":
                self._watch(self._now())
            return self._state == state

    def end(self, why: str) -> None:
        """End the lead; nothing is taken any more."""
        with self._lock:
            if self._state != "over":
                self._state, self.why = "over", why

    def beat(self) -> Beat:
        """Return what the control step that begins now has to do."""
        with self._lock:
            if self._state != "over":
                self._watch(self._now())
            begins, self._begins = self._begins, False
            return Beat(self._state, self._action, begins, self.why)

    def _watch(self, now: float) -> None:
        """Hold a robot whose leader is silent, and give up a leader that stays so."""
        self._began = now if self._began is None else self._began
        silent = now - (self._began if self._fresh_at is None else self._fresh_at)
        if silent > LOST_S:
            self._state, self.why = "over", f"{self.leader} has been silent for {LOST_S:g} s"
        elif silent > (FIRST_S if self._fresh_at is None else self._ages.limit_s):
            self._hold(self._silence(silent))

    def saw(self, joints: Mapping[str, float]) -> None:
        """Note what a control step has read."""
        self._joints = dict(joints)
        self.seen.set()

    def wrote(self, action: Mapping[str, float]) -> None:
        """Note what a control step has written."""
        self._written = dict(action)

    def facts(self) -> dict[str, Any]:
        """Return the answer to a command."""
        with self._lock:
            return {
                "state": self._state,
                "why": self.why,
                "turn": self._turn,
                "seq": self._seq,
                "joints": self._joints,
                "written": self._written,
                "one_way_ms": round(1000 * self._ages.one_way_s, 3),
                "dropped": self.counts.stale + self.counts.disordered,
                "now": self._now(),
            }


class LedPolicy:
    """A lead as the policy of a rollout, with the policy that it takes over from.

    Each action is within the ranges and bounded in speed. A turn of the leader begins where the robot is; when the
    policy has its turn again, what it had planned before is dropped.

    Args:
        lead: its commands.
        policy: drives in the other turns; None for a robot that holds in them.
        guide: how the leader's numbers are meant.
        max_speed: whole joint ranges a second that a leader may cross.
        period: control period, in seconds.
    """

    def __init__(
        self, lead: Lead, policy: Policy | None, *, guide: str = "positions", max_speed: float, period: float
    ) -> None:
        self.lead = lead
        self.led_by = ""
        """The leader while it has taken over from the policy; see :class:`Led`."""
        self.turn = TurnOfDriver("", lead.leader)
        self.reach: Ranges = {}
        """The ranges of this beat; see :class:`Led`."""
        self.follows_instruction = getattr(policy, "follows_instruction", True)
        self.errors = self.event_errors = 0
        self.last_error = ""
        self._policy = policy
        given: object = policy
        self._paced = given if isinstance(given, Paced) else None
        self._restartable = given if isinstance(given, Restartable) else None
        self._guide = guide
        self._max_speed, self._period = max_speed, period
        self._instruction, self._ranges = "", dict[str, tuple[float, float]]()
        self._speeds: dict[str, float] = {}
        self._last_counts: dict[str, float] = {}
        self._chunk: list[Action] = []
        self._last: Action = {}
        self._wrote: Action = {}
        self._from: dict[str, float] = {}
        self._place: Action = {}
        self._present, self._before = dict[str, float](), dict[str, float]()

    @property
    def uses_cameras(self) -> bool:
        """True while the policy has its turn and looks at pictures."""
        return self._policy is not None and self.lead.state == "policy" and self._policy.uses_cameras

    @property
    def preparing(self) -> bool:
        """True while the policy has had no action yet."""
        return self._paced is not None and self._paced.preparing and self.lead.state == "policy"

    @property
    def frames(self) -> int:
        """Commands that were fresh."""
        return self.lead.counts.fresh

    def miss(self, ticks: int) -> None:
        """Skip actions of the policy, while it has its turn."""
        if self._paced is not None and self.lead.state == "policy":
            self._paced.miss(ticks)

    def counts(self) -> dict[str, float]:
        """Return the figures of the lead, and of the policy."""
        own = {f"leader_{name}": float(value) for name, value in vars(self.lead.counts).items()}
        policy: object = self._policy
        return {**own, **(policy.counts() if isinstance(policy, Counted) else self._last_counts)}

    def reset(self, instruction: str, ranges: Ranges) -> None:
        self._instruction, self._ranges, self.reach = instruction, dict(ranges), dict(ranges)
        self._speeds = speeds_across(ranges, self._max_speed, LEADER_UNBOUNDED_PER_S)
        if self._policy is not None:
            self._policy.reset(instruction, ranges)

    def act(self, observation: Mapping[str, Any]) -> Action | list[Action] | None:
        """Return the action of this control step; None when the leader has ended it.

        Raises:
            PolicyError: the leader was lost.
        """
        beat = self.lead.beat()
        self._before, self._present = self._present, numbers(observation)
        self.lead.saw(self._present)
        if beat.state != "over":
            self.turn = TurnOfDriver(beat.state, self.lead.leader, beat.why)
        self.led_by = self.lead.leader if beat.state == "led" and self._policy is not None else ""
        if beat.state == "over":
            if self.lead.why:
                raise PolicyError(self.lead.why)
            return None
        if beat.state == "held":
            if beat.begins:
                self._place = self._held()
            # Written at each beat: a recording then has frames of it. Nothing is before the first turn.
            return dict(self._place) or []
        if beat.state == "policy":
            self.reach = self._ranges
            return self._of_policy(observation, anew=beat.begins)
        try:
            return self._led(beat)
        except ValidationError as exc:
            self.errors, self.last_error = self.errors + 1, str(exc)
            self.lead.hold(f"{self.lead.leader}: {exc}")
            return self._held()

    def wrote(self, action: Mapping[str, float]) -> None:
        """Tell the leader what was written; see :class:`Noting`."""
        self._wrote = {**self._wrote, **action}
        self.lead.wrote(action)

    def hold(self, why: str) -> None:
        """Hold the robot until the next turn; see :class:`Led`."""
        self.lead.hold(why)

    def interrupt(self) -> None:
        policy = self._policy
        if policy is not None:
            policy.interrupt()

    def close(self) -> None:
        self.lead.end("")
        policy = self._policy
        if policy is not None:
            self._last_counts = dict(policy.counts()) if isinstance(policy, Counted) else {}
            # The leader's last session is kept, and its policy may be large.
            self._policy = self._paced = self._restartable = None
            policy.close()

    def _held(self) -> Action:
        """Return the action that keeps the robot where it is.

        One wrong reading moves nothing: of it, the reading before and the place that was written the middle counts.
        """
        self._drop_plan()
        place: Action = {}
        for key in self._ranges:
            if is_velocity(key):
                place[key] = 0.0
            elif key in self._present:
                known = [each[key] for each in (self._before, self._wrote) if key in each]
                place[key] = median([self._present[key], *known]) if len(known) == 2 else self._present[key]
        self.reach = self._out_to(place)
        return place

    def _out_to(self, place: Action) -> Ranges:
        """Return the ranges, wide enough for a place beyond them."""
        return {
            key: (min(low, place.get(key, low)), max(high, place.get(key, high)))
            for key, (low, high) in self._ranges.items()
        }

    def _drop_plan(self) -> None:
        """Forget what the policy had planned, while somebody else drives."""
        self._chunk = []
        if self._restartable is not None:
            self._restartable.restart()

    def _of_policy(self, observation: Mapping[str, Any], *, anew: bool) -> Action | list[Action] | None:
        if self._policy is None:
            return []
        if anew:
            self._drop_plan()
            if self._restartable is None:
                self._policy.reset(self._instruction, self._ranges)
        if not self._chunk:
            answer = self._policy.act(observation)
            if not self.lead.is_still("policy"):
                # It took its time, and its answer comes too late.
                return []
            if answer is None:
                return None
            self._chunk = [dict(answer)] if isinstance(answer, Mapping) else [dict(each) for each in answer]
        return self._chunk.pop(0) if self._chunk else []

    def _led(self, beat: Beat) -> Action:
        wanted = checked_action(beat.action, dict.fromkeys(self._ranges, (-math.inf, math.inf)))
        if beat.begins:
            # Joints that it does not lead keep the place that they have now.
            self._place = self._held()
            # Those that the robot does not tell are bounded from where they were sent.
            self._last, self._from = {**self._wrote, **self._place}, {}
        # A joint beyond its range stays where it is or comes back, and goes no further out.
        self.reach = self._out_to(self._last)
        if self._guide == "differences":
            wanted = self._moved(wanted)
        target = checked_action(wanted, self.reach)
        bounded = limited(target, self._last, self._speeds, self._period)
        self._last = {**self._last, **bounded}
        return {**self._place, **{key: self._last[key] for key in target}}

    def _moved(self, wanted: Action) -> Action:
        """Return the robot's place when its leader is at ``wanted``, by differences."""
        moved: Action = {}
        for key, value in wanted.items():
            if is_velocity(key):
                moved[key] = value
                continue
            if key not in self._place:
                raise ValidationError(f"{shown(key)} cannot be led by differences: the robot does not tell it.")
            low, high = self.reach[key]
            apart = self._from.setdefault(key, value - self._last[key])
            # Beyond the range the leader turns around where the robot is, not where it would be.
            moved[key] = min(max(value - apart, low), high)
            self._from[key] = value - moved[key]
        return moved
