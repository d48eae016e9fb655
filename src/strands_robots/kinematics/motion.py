"""A planned motion as a policy: segments of setpoints, played one a control step."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from strands_robots.kinematics.arm import Action, ArmState, JawMap, JointMap
from strands_robots.kinematics.stall import StallWatch
from strands_robots.policies.base import PolicyError, Ranges, numbers
from strands_robots.utils import shown

if TYPE_CHECKING:  # joints without a model are moved without MuJoCo
    from strands_robots.kinematics.chain import Floats

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

    def told(self, targets: Mapping[str, float]) -> Floats:
        """Return the joints that a body was told; NaN where that is not known."""

    def holding(self, state: ArmState, told: float) -> bool | None:
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
        told: the last opening that the gripper is told, None for none.
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
    told: float | None = None
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
        self._told: Floats | None = None
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
        self._told = self.arm.told(frame)
        return frame

    def _require_progress(self, state: ArmState) -> None:
        """End the motion where a joint stands still against what it is told.

        Raises:
            PolicyError: a joint met something; :attr:`contact` has the sentence.
        """
        if self._told is None or self._watch is None or not self._frames:
            return
        told = np.where(np.isnan(self._told), state.joints, self._told)
        currents = self.currents
        read = None if currents is None else lambda: self._by_joint(currents())
        index = self._watch.stalled(self.clock(), told, state.joints, read)
        if index is not None:
            joint = self.arm.joints[index]
            at = f"{np.degrees(state.joints[index]):.0f} degrees" if joint.turns else f"{state.joints[index]:.3f} m"
            self.contact = f"{joint.name} was blocked at {at}: it met something, or its servo is too weak"
            raise PolicyError(self.contact)

    def _by_joint(self, currents: Mapping[str, float]) -> Floats:
        """Return currents in the order of the joints, NaN where one is not known."""
        return np.array([currents.get(each.observed, np.nan) for each in self.arm.maps])

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
