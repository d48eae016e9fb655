"""A planned motion as a policy: segments of setpoints, played one a control step.

Contact is seen as a joint that stands still when told to move. A joint is compared with its setpoints now and
:data:`DELAY_S` ago, so that neither the delay of a servo nor the sag of an arm under its payload counts: a joint that
sags follows its setpoints, at a distance. Where the body reads the currents of its motors, one that rises shows contact
at a smaller lag; a current alone, of a payload, shows none.

Of a robot that only states its joints no shape is known, so the way of its motions is not checked for contacts.
"""

from __future__ import annotations

import threading
import time
from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from strands_robots.kinematics import StatedJoint
from strands_robots.kinematics.arm import (
    ACCELERATION_RAD_S2,
    SLIDE_SPEED_M_S,
    Action,
    ArmState,
    Bounds,
    JawMap,
    JointMap,
    timed,
)
from strands_robots.policies.base import JOINT_SPEED_RAD_S, PolicyError, Ranges, numbers
from strands_robots.policies.rollout import Rollout
from strands_robots.utils import ValidationError, shown

if TYPE_CHECKING:  # MuJoCo is not needed to watch joints
    from strands_robots.kinematics.chain import Floats
    from strands_robots.kinematics.objects import Sight

WINDOWS_S = (0.12, 0.22)
"""Times over which a joint is compared with its setpoints; the longer one is for slow motions."""

SLOW_WINDOWS_S = (0.45, 0.9, 1.8)
"""Such times for joints that go less than :data:`SETPOINT_WAY` in the others, down to 0.0045 rad/s."""

SLOW_SHARE = 0.1
"""Least way of a slow joint by that of the fastest: the sag of an arm that others stretch out is no contact."""

DELAY_S = 0.12
"""Greatest delay of a servo behind its setpoints."""

SETPOINT_WAY = 0.008
"""Least way of the setpoints in such a time by which a joint is judged (rad or m)."""

FOLLOWED = 0.2
"""Share of its way that a joint goes at least; one in contact goes less."""

STILL = 0.012
"""A joint that goes further in such a time does not stand still (rad or m)."""

CONFIRMED = 2
"""Control steps in a row in which a joint stands still."""

READ_LAG = 0.0087
"""Lag of a joint that stands still from which its current is read (rad or m): half a degree."""

PRESS_LAG = 0.0175
"""Least lag of a joint in contact whose current rises (rad or m): one degree."""

RISE_A = 0.25
"""Least rise of the current of a joint in contact over its lowest while it stands still (A).

A tenth of the stall current of an STS3215, and more than the 0.18 A that it draws to turn without a load. The rise also
has to be as much as the lowest current: a gear that carries a payload sticks until its current has risen by twice its
friction, which is less than that while the friction is below a third of the load. Assumed, not measured on real motors.
"""


class StallWatch:
    """Compares the joints of one motion with what they are told; for one thread.

    Args:
        lag: least distance of a joint from its setpoint, beyond that at the motion's start (rad or m).
    """

    def __init__(self, lag: float) -> None:
        self._lag = lag
        self._seen: list[tuple[float, Floats, Floats]] = []
        self._times: list[float] = []
        self._counts: Floats = np.zeros(0)
        self._lowest: Floats = np.zeros(0)
        self._reads = True

    def stalled(
        self, now: float, setpoints: Floats, joints: Floats, currents: Callable[[], Floats] | None = None
    ) -> int | None:
        """Return the joint that stands still against its setpoints, if there is one.

        Args:
            now: the body's own time in seconds.
            setpoints: of each joint (rad or m).
            joints: where they are.
            currents: reads the current of each joint's motor (A, NaN where it is not known), of which the sign does
                not count. Called only where a joint stands still at less than the full lag, and no more once it
                knows none.
        """
        if self._seen and now <= self._seen[-1][0]:
            return None
        self._seen.append((now, setpoints, joints))
        self._times.append(now)
        # The first look stays, for the distance at the start.
        while len(self._seen) > 2 and self._seen[1][0] < now - DELAY_S - SLOW_WINDOWS_S[-1] - 0.1:
            del self._seen[1], self._times[1]
        if not len(self._counts):
            self._counts = np.zeros(len(joints))
            self._lowest = np.full(len(joints), np.nan)
        lags, steady = self._still(now)
        # Where the lag is enough, nothing is read.
        pressing = self._pressing(np.where(lags >= self._lag, -np.inf, steady), currents)
        self._counts = np.where((lags >= self._lag) | pressing, self._counts + 1, 0)
        worst = int(np.argmax(np.where(self._counts >= CONFIRMED, np.abs(setpoints - joints), -1.0)))
        return worst if self._counts[worst] >= CONFIRMED else None

    def _pressing(self, lags: Floats, currents: Callable[[], Floats] | None) -> np.ndarray[Any, np.dtype[np.bool_]]:
        """Return which joints stand still with a current that has risen."""
        suspect = lags >= READ_LAG
        drawn = np.full(len(lags), np.nan)
        if currents is not None and self._reads and bool(np.any(suspect)):
            read = np.abs(currents())
            drawn = np.where(np.isfinite(read), read, np.nan)
            # A lost answer costs the bus some control steps, so it is not asked again.
            self._reads = not np.isnan(drawn).all()
        self._lowest = np.where(suspect, np.fmin(self._lowest, drawn), np.nan)
        rise = drawn - self._lowest
        result: np.ndarray[Any, np.dtype[np.bool_]] = (lags >= PRESS_LAG) & (rise >= np.fmax(RISE_A, self._lowest))
        return result

    def _still(self, now: float) -> Floats:
        """Return the lag of joints that do not follow, and of those that stand still.

        Both are the greatest of all windows, and minus infinity for the other joints.
        A joint that sinks under its payload as a motion begins draws more and more, and does not stand still.
        """
        first, last = self._seen[0], self._seen[-1]
        oldest = self._seen[1 if len(self._seen) > 1 else 0][0]
        windows = [window for window in (*WINDOWS_S, *SLOW_WINDOWS_S) if now - window >= oldest]
        if not windows:
            return np.full((2, len(last[2])), -np.inf)
        # One row for each window: the control thread has no time for one after another.
        before, earliest = ([self._at(now - delay - window) for window in windows] for delay in (0.0, DELAY_S))
        way_now = last[1] - np.array([look[1] for look in before])
        way_before = self._at(now - DELAY_S)[1] - np.array([look[1] for look in earliest])
        way = np.where(
            way_now * way_before > 0, np.sign(way_now) * np.minimum(np.abs(way_now), np.abs(way_before)), 0.0
        )
        gone = (last[2] - np.array([look[2] for look in before])) * np.sign(way)
        lag = ((last[1] - last[2]) - (first[1] - first[2])) * np.sign(way)
        fast = np.array([[window in WINDOWS_S] for window in windows])
        way = np.where(fast | (np.abs(way) >= SLOW_SHARE * np.abs(way_now).max(axis=1, keepdims=True)), way, 0.0)
        most = np.minimum(FOLLOWED * np.abs(way), STILL)
        behind = (np.abs(way) >= SETPOINT_WAY) & (gone <= most)
        found: Floats = np.where([behind, behind & (gone >= -most)], lag, -np.inf).max(axis=1)
        return found

    def _at(self, when: float) -> tuple[float, Floats, Floats]:
        """Return the last look at or before a time, else the first."""
        return self._seen[max(0, bisect_right(self._times, when) - 1)]


_QUOTES = "'\""

SETTLE_S = 1.0
"""Longest wait after a segment for the arm to stand still."""

STILL_RAD = 3e-3
STILL_STEPS = 5
"""The arm stands still when no joint moves by more in each of so many control steps of the body's own time."""

NEAR_MM = 15.0
"""A motion that ends further from its goal has failed."""

NEAR_RAD = 0.1
"""A joint that ends further from where it was told to go has failed, in radians; of a slide :data:`NEAR_MM`."""

FRESH = 0.9
"""Share of a control step by which the body's own time must have advanced between two looks."""

STALL_LAG = 0.01
"""Least lag of a joint in contact, of a body that observes and moves exactly (rad or m)."""

MARGIN_S = 5.0
"""Seconds beyond its plan that a motion may take."""


class MovedJoint(Protocol):
    """A joint as a motion names it; it turns, or slides."""

    @property
    def name(self) -> str:
        """Name in answers."""

    @property
    def turns(self) -> bool:
        """True for radians, False for metres."""


class JointSpace(Protocol):
    """Joints that a motion moves: those of an arm's model, or stated by a robot."""

    @property
    def joints(self) -> Sequence[MovedJoint]:
        """The joints, in the order of every array of positions."""

    @property
    def maps(self) -> Sequence[JointMap]:
        """Maps of the joints to the body's keys, in the same order."""

    @property
    def jaw(self) -> JawMap | None:
        """Keys of the gripper, None without one."""

    def state(self, observation: Mapping[str, float]) -> ArmState:
        """Return the state in an observation; raises :class:`ValidationError`."""

    def setpoints(self, targets: Mapping[str, float]) -> Floats:
        """Return the joints that a body was told; NaN where that is not known."""

    def holding(self, state: ArmState, opening: float) -> bool | None:
        """Return True where something keeps the jaws open; None without a gripper."""

    def reached(self, state: ArmState | None, goal: Floats | None, wanted: Mapping[str, float]) -> dict[str, Any]:
        """Return ``reached``, ``error_mm`` and what else the answer has of the end."""


@dataclass(frozen=True, slots=True)
class Segment:
    """Setpoints by control step, and the name of this part of the motion."""

    name: str
    frames: Sequence[Action]
    settles: bool = False


@dataclass
class Motion:
    """Policy that plays planned segments; its rollout has permit and events.

    Attributes:
        arm: the joints that it moves.
        verb: what was asked for.
        asked: the caller's goal, as it is answered.
        goal: where the tip shall be in the end (m), None for a motion of the gripper alone.
        end_joints: where the joints shall be in the end (rad); empty for a motion of the gripper alone.
        wanted: where joints shall be in the end, by name (rad or m).
        opening: the last one that the gripper is told, None for none.
        grasps: something shall be between the jaws in the end.
        stall_lag: least lag of a joint that counts as contact with something (rad or m).
        currents: reads the currents of the body's motors by its observation's keys (A), None where it cannot.
        contact: what ended the motion, if a joint met something.
        clock: the body's own time in seconds; a simulation's stands still with it.
        state: what was observed last.
        segment: name of the segment that is played.
    """

    arm: JointSpace
    verb: str
    asked: Mapping[str, Any]
    segments: Sequence[Segment]
    hz: float
    goal: Floats | None = None
    end_joints: Floats = field(default_factory=lambda: np.zeros(0))
    wanted: Mapping[str, float] = field(default_factory=dict)
    opening: float | None = None
    grasps: bool = False
    clock: Callable[[], float] = time.monotonic
    stall_lag: float = STALL_LAG
    currents: Callable[[], Mapping[str, float]] | None = None
    state: ArmState | None = field(default=None, init=False)
    contact: str = field(default="", init=False)
    segment: str = field(default="", init=False)
    uses_cameras: bool = field(default=False, init=False)

    def __post_init__(self) -> None:
        self._left = deque(self.segments)
        self._frames: deque[Action] = deque()
        self._settles_until: float | None = None
        self._still = 0
        self._seen: tuple[float, ArmState] | None = None
        self._setpoints: Floats | None = None
        self._watch: StallWatch | None = None

    @property
    def instruction(self) -> str:
        """Return the motion in one line, as events name it."""
        words = [self.verb]
        for name, value in self.asked.items():
            several = value if isinstance(value, Mapping) else {name: value}
            words += [f"{each} {shown(what).strip(_QUOTES)}" for each, what in several.items()]
        return " ".join(words)

    @property
    def duration(self) -> float:
        """Longest time that the motion may take, in seconds."""
        frames = sum(len(segment.frames) for segment in self.segments)
        return frames / self.hz + SETTLE_S * sum(segment.settles for segment in self.segments) + MARGIN_S

    @property
    def finished(self) -> bool:
        """True once every setpoint was played."""
        return not self._left and not self._frames

    def problem(self, error_mm: float | None, holding: bool | None) -> str:
        """Return why a motion that was played did not do what was asked; empty if it did."""
        if self.grasps and not holding:
            return "the jaws closed on nothing"
        stopped_short = self._stopped_short()
        if stopped_short:
            return stopped_short
        if error_mm is not None and error_mm > NEAR_MM:
            return f"the tip is {error_mm:.0f} mm from where it was told to go"
        return ""

    def _stopped_short(self) -> str:
        """Name the first joint that is far from where it was told to go; empty for none."""
        joints = self.arm.joints if self.state is not None else ()
        for joint, at in zip(joints, () if self.state is None else self.state.joints, strict=True):
            off = abs(self.wanted.get(joint.name, at) - at)
            if joint.turns and off > NEAR_RAD:
                return f"{joint.name} is {np.degrees(off):.0f} degrees from where it was told to go"
            if not joint.turns and 1000 * off > NEAR_MM:
                return f"{joint.name} is {1000 * off:.0f} mm from where it was told to go"
        return ""

    def reset(self, instruction: str, ranges: Ranges) -> None:
        """Do nothing: the motion was planned before it started."""

    def act(self, observation: Mapping[str, Any]) -> Action | Sequence[Action] | None:
        """Return the next setpoints, nothing while the arm settles, None at the end."""
        self.state = self.arm.state(numbers(observation))
        self._require_progress(self.state)
        while not self._frames:
            if self._settles_until is not None:
                if not self._settled(self.state, self.clock()):
                    return ()
                self._settles_until = None
            if not self._left:
                return None
            segment = self._left.popleft()
            self.segment = segment.name
            self._frames.extend(segment.frames)
            self._settles_until = np.inf if segment.settles else None
            self._still, self._seen = 0, None
            self._watch = StallWatch(self.stall_lag)
        frame = self._frames.popleft()
        self._setpoints = self.arm.setpoints(frame)
        return frame

    def _require_progress(self, state: ArmState) -> None:
        """End the motion where a joint stands still against what it is told.

        Raises:
            PolicyError: a joint met something; :attr:`contact` has the sentence.
        """
        if self._setpoints is None or self._watch is None or not self._frames:
            return
        setpoints = np.where(np.isnan(self._setpoints), state.joints, self._setpoints)
        currents = self.currents

        def read() -> Floats:
            """Return currents in the order of the joints, NaN where one is not known."""
            known = {} if currents is None else currents()
            return np.array([known.get(each.observed, np.nan) for each in self.arm.maps])

        index = self._watch.stalled(self.clock(), setpoints, state.joints, None if currents is None else read)
        if index is not None:
            joint = self.arm.joints[index]
            at = f"{np.degrees(state.joints[index]):.0f} degrees" if joint.turns else f"{state.joints[index]:.3f} m"
            self.contact = f"{joint.name} was blocked at {at}: it met something, or its servo is too weak"
            raise PolicyError(self.contact)

    def interrupt(self) -> None:
        """Do nothing: this policy never waits."""

    def close(self) -> None:
        """Do nothing: this policy has no resources."""

    def _settled(self, state: ArmState, now: float) -> bool:
        """Return True once the arm has stood still, or was waited for long enough."""
        if self._seen is None:
            self._seen, self._settles_until = (now, state), now + SETTLE_S
            return False
        seen_at, seen = self._seen
        if now - seen_at < FRESH / self.hz:
            return False
        jaw = abs((state.opening or 0.0) - (seen.opening or 0.0))
        still = float(np.abs(state.joints - seen.joints).max()) <= STILL_RAD and jaw <= STILL_RAD
        self._seen, self._still = (now, state), self._still + 1 if still else 0
        return self._still >= STILL_STEPS or (self._settles_until is not None and now >= self._settles_until)


CHECKED = "limits"
"""What the way of such a motion is checked for, as its answer says."""


@dataclass(frozen=True)
class StatedJoints:
    """The joints of one motion; positions are radians, of a slide metres."""

    joints: tuple[StatedJoint, ...]

    @property
    def maps(self) -> tuple[JointMap, ...]:
        """Maps of the joints to the robot's keys."""
        return tuple(JointMap(each.key, each.key, each.factor) for each in self.joints)

    @property
    def jaw(self) -> JawMap | None:
        """None: no joint is known to be a gripper."""
        return None

    @property
    def bounds(self) -> Bounds:
        """Speed and acceleration of each joint at full speed."""
        speeds = [
            min(JOINT_SPEED_RAD_S if each.turns else SLIDE_SPEED_M_S, each.speed / abs(each.factor))
            for each in self.joints
        ]
        return Bounds(np.array(speeds), np.full(len(speeds), ACCELERATION_RAD_S2))

    def state(self, observation: Mapping[str, float]) -> ArmState:
        """Return the positions in an observation.

        Raises:
            ValidationError: the observation lacks one of the joints.
        """
        missing = [each.name for each in self.joints if each.key not in observation]
        if missing:
            raise ValidationError(f"the joints {', '.join(missing)} could not be read.")
        return ArmState(np.array([each.radians(observation[each.observed]) for each in self.maps]), None)

    def setpoints(self, targets: Mapping[str, float]) -> Floats:
        """Return the positions that the robot was told; NaN where that is not known."""
        return np.array([each.radians(targets.get(each.commanded, np.nan)) for each in self.maps])

    def action(self, positions: Floats) -> Action:
        """Return the targets of positions."""
        return {each.commanded: each.value(float(at)) for each, at in zip(self.maps, positions, strict=True)}

    def holding(self, state: ArmState, opening: float) -> bool | None:
        """Return None: no joint is known to be a gripper."""
        return None

    def reached(self, state: ArmState | None, goal: Floats | None, wanted: Mapping[str, float]) -> dict[str, Any]:
        """Return ``reached``, the joints, and the greatest error in degrees and mm.

        ``checked`` says what the way was checked for.
        """
        fields: dict[str, Any] = {"reached": None, "error_mm": None, "error_deg": None, "checked": CHECKED}
        if state is None:
            return fields
        joints = {}
        for joint, at in zip(self.joints, state.joints, strict=True):
            off = abs(wanted.get(joint.name, at) - at)
            key, error = ("error_deg", np.degrees(off)) if joint.turns else ("error_mm", 1000 * off)
            fields[key] = max(fields[key] or 0.0, round(float(error), 2))
            joints[joint.name] = round(float(np.degrees(at)) if joint.turns else float(at), 3)
        return {**fields, "reached": {"joints": joints}}


def chosen(known: Sequence[StatedJoint], wanted: Mapping[str, float]) -> dict[StatedJoint, float]:
    """Return the joints that a caller names, and where they shall be (rad or m).

    Args:
        known: the joints of the robot.
        wanted: degrees by name or key, metres for a slide.

    Raises:
        ValidationError: an unknown joint, one that cannot be moved, or a position outside its limits.
    """
    by_name = {each.key: each for each in known} | {each.name: each for each in known}
    found: dict[StatedJoint, float] = {}
    for name, value in wanted.items():
        joint = by_name.get(name)
        if joint is None:
            raise ValidationError(f"joints must be of {', '.join(each.name for each in known)}; there is no {name}.")
        if joint in found:
            raise ValidationError(f"joints must name {joint.name} once.")
        found[joint] = joint.position(value)
    return found


def move_joints(
    goals: Mapping[StatedJoint, float],
    state: ArmState,
    still: Action,
    asked: Mapping[str, float],
    *,
    hz: float,
    speed: float,
) -> Motion:
    """Move joints on a straight line between their positions, at bounded speed.

    Args:
        goals: where each joint shall be (rad or m).
        state: where they are, in the same order.
        still: targets of what stays where it is; devices may want every key in an action.
        asked: what the caller asked for.
        hz: control rate.
        speed: share of full speed, above 0 to 1.
    """
    space, goal = StatedJoints(tuple(goals)), np.array(list(goals.values()))
    way = timed(np.array([state.joints, goal]), space.bounds.scaled(speed))
    frames = [{**still, **space.action(positions)} for positions in way.sampled(hz)]
    return Motion(
        space,
        "moveJoints",
        {"joints": dict(asked)},
        [Segment("move", frames, settles=True)],
        hz,
        end_joints=goal,
        wanted={joint.name: at for joint, at in goals.items()},
    )


@dataclass
class ArmTask:
    """One motion, running or ended.

    Attributes:
        outcome: how it ended, once it was asked for; it stays as it was then.
        sight: the objects before and after it; None where none can be seen.
        looked: set once the objects were looked at after it.
    """

    task_id: str
    rollout: Rollout
    motion: Motion
    outcome: dict[str, Any] | None = None
    sight: Sight | None = None
    looked: threading.Event = field(default_factory=threading.Event)

    @property
    def running(self) -> bool:
        """True until the motion has ended; a look at its end does not count."""
        return self.rollout.running

    @property
    def unseen(self) -> bool:
        """True while the end of a completed motion is looked at."""
        return self.rollout.state == "completed" and self.sight is not None and not self.looked.is_set()

    def join(self, seconds: float) -> None:
        """Wait for the end and the look at it."""
        until = time.monotonic() + seconds
        self.rollout.join(seconds)
        if self.unseen:
            self.looked.wait(max(0.0, until - time.monotonic()))
