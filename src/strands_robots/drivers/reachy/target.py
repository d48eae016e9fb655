"""Head poses and targets of a Reachy Mini, in metres and radians, and gestures.

A pose is relative to the head's upright rest. Angles are extrinsic x-y-z, ``R = Rz(yaw) Ry(pitch) Rx(roll)``: positive
pitch looks down, positive yaw looks left (the daemon's REST convention).

The daemon silently ignores a target out of its reach, so it is refused here, by name. The bounds lie inside the
measured reach of the daemon's own inverse kinematics and motor limits (1.13.0): roll +-47 degrees, pitch -72 to +48,
x -46 to +50 mm, y +-47 mm, z -50 to +23 mm, with corners such as pitch 40 and roll 40 unsolvable.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

from strands_robots.utils import ValidationError, number, plain_scalar, shown

TILT, TILT_SUM = math.radians(40), math.radians(60)
"""Largest pitch or roll of the head, and largest sum of the two."""

NECK_YAW = math.radians(65)
"""Largest angle between head and body."""

STREAM_HZ = 50.0
FRAME_STEP = 0.3
RAMP_STEP = 0.1
FRAME_STEP_M = 0.01
"""Largest way of one frame of the stream, and of one frame of a ramp: radians, and metres of the head."""

INIT_ANTENNAS = (-0.1745, 0.1745)
SLEEP_ANTENNAS = (-3.05, 3.05)
"""Rest positions, right then left, radians (the daemon's own constants)."""

HEAD_KEYS = ("head_x", "head_y", "head_z", "head_roll", "head_pitch", "head_yaw")
ACTION_KEYS = (*HEAD_KEYS, "body_yaw", "antenna_right", "antenna_left")

BOUNDS = {
    "head_x": (-0.025, 0.025),
    "head_y": (-0.025, 0.025),
    "head_z": (-0.030, 0.015),
    "head_roll": (-TILT, TILT),
    "head_pitch": (-TILT, TILT),
    "head_yaw": (-math.pi, math.pi),
    "body_yaw": (-math.radians(160), math.radians(160)),
    "antenna_right": (-math.pi, math.pi),
    "antenna_left": (-math.pi, math.pi),
}
"""Lowest and highest value of every action key."""

ORTHONORMAL_WITHIN = 0.01
"""Largest error of a rotation read from the daemon; its own kinematics are exact to about 3e-4."""

_ROUNDING = 1e-9
_ROTATION = (0, 1, 2, 4, 5, 6, 8, 9, 10)

# A gesture needs room on top of a tilted head: 20 + 20 + 15 degrees stay below the 60 of pitch and roll together.
_CENTRE = math.radians(20)
_NOD, _SHAKE, _WIGGLE = math.radians(15), math.radians(20), math.radians(35)
_SHAKE_CENTRE = math.radians(150)


@dataclass(frozen=True, slots=True)
class HeadPose:
    """``x``, ``y``, ``z`` in metres, ``roll``, ``pitch``, ``yaw`` in radians."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    roll: float = 0.0
    pitch: float = 0.0
    yaw: float = 0.0

    def numbers(self) -> tuple[float, ...]:
        """Return the six numbers in the order of ``HEAD_KEYS``."""
        return (self.x, self.y, self.z, self.roll, self.pitch, self.yaw)

    def matrix(self) -> list[float]:
        """Return the homogeneous transform, row-major, sixteen numbers."""
        cr, sr = math.cos(self.roll), math.sin(self.roll)
        cp, sp = math.cos(self.pitch), math.sin(self.pitch)
        cy, sy = math.cos(self.yaw), math.sin(self.yaw)
        return [
            *(cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr, self.x),
            *(sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr, self.y),
            *(-sp, cp * sr, cp * cr, self.z),
            *(0.0, 0.0, 0.0, 1.0),
        ]

    @classmethod
    def from_matrix(cls, flat: Sequence[float]) -> HeadPose:
        """Read a row-major transform. At pitch +-90 degrees roll is taken as zero.

        Raises:
            ValidationError: not sixteen finite numbers, or no rotation in them.
        """
        m = list(flat)
        if len(m) != 16 or not all(map(math.isfinite, m)):
            raise ValidationError(f"head pose must be 16 finite numbers, not {shown(flat)}.")
        rows = (m[0:3], m[4:7], m[8:11])
        off = max(abs(_dot(rows[i], rows[j]) - (i == j)) for i in range(3) for j in range(i, 3))
        if off > ORTHONORMAL_WITHIN:
            raise ValidationError(f"head pose must hold a rotation; its rows are {off:.3g} from orthonormal.")
        pitch = math.atan2(-m[8], math.hypot(m[0], m[4]))
        if math.hypot(m[0], m[4]) < 1e-9:
            roll, yaw = 0.0, math.atan2(-m[1], m[5])
        else:
            roll, yaw = math.atan2(m[9], m[10]), math.atan2(m[4], m[0])
        return cls(m[3], m[7], m[11], roll, pitch, yaw)

    def angle_to(self, other: HeadPose) -> float:
        """Return the angle of the one rotation to ``other``, in radians."""
        a, b = self.matrix(), other.matrix()
        # The chord keeps small angles exact where the arc cosine of a trace near 3 loses half its digits:
        # |A - B| in the Frobenius norm is sqrt(8) sin(angle / 2).
        chord = math.sqrt(sum((a[i] - b[i]) ** 2 for i in _ROTATION))
        return 2 * math.asin(min(1.0, chord / math.sqrt(8)))

    def turn_to(self, other: HeadPose) -> float:
        """Return the changes of roll, pitch and yaw added up: at least ``angle_to``."""
        return abs(self.roll - other.roll) + abs(self.pitch - other.pitch) + abs(self.yaw - other.yaw)

    def distance_to(self, other: HeadPose) -> float:
        """Return the distance between the two head positions in metres."""
        return math.dist((self.x, self.y, self.z), (other.x, other.y, other.z))

    def toward(self, other: HeadPose, share: float) -> HeadPose:
        """Return the pose at ``share`` (0 to 1) of the way, exactly ``other`` at 1."""
        if share >= 1:
            return other
        return HeadPose(*(a + (b - a) * share for a, b in zip(self.numbers(), other.numbers(), strict=True)))


@dataclass(frozen=True, slots=True)
class Target:
    """Targets of head, body yaw and antennas (right, left), in metres and radians."""

    head: HeadPose | None = None
    body_yaw: float | None = None
    antennas: tuple[float, float] | None = None

    def over(self, below: Target) -> Target:
        """Return this target with its missing parts taken from ``below``."""
        return Target(
            self.head if self.head is not None else below.head,
            self.body_yaw if self.body_yaw is not None else below.body_yaw,
            self.antennas if self.antennas is not None else below.antennas,
        )

    def step_from(self, start: Target) -> float:
        """Return the largest way of any part from ``start``, in steps of one frame."""
        steps = [0.0]
        if self.head and start.head:
            # The sum of the angles bounds the turn and, unlike it, divides evenly over the frames of a ramp. The body
            # follows the head's yaw, so a turn through the back counts in full.
            steps.append(self.head.turn_to(start.head) / FRAME_STEP)
            steps.append(self.head.distance_to(start.head) / FRAME_STEP_M)
        if self.body_yaw is not None and start.body_yaw is not None:
            steps.append(abs(self.body_yaw - start.body_yaw) / FRAME_STEP)
        if self.antennas and start.antennas:
            steps.extend(abs(a - b) / FRAME_STEP for a, b in zip(self.antennas, start.antennas, strict=True))
        return max(steps)

    def toward(self, end: Target, share: float) -> Target:
        """Return the target at ``share`` (0 to 1) of the way, in the parts of ``end``."""
        if share >= 1:
            return end
        head, body, antennas = end.head, end.body_yaw, end.antennas
        if head and self.head:
            head = self.head.toward(head, share)
        if body is not None and self.body_yaw is not None:
            body = self.body_yaw + (body - self.body_yaw) * share
        if antennas and self.antennas:
            right, left = (a + (b - a) * share for a, b in zip(self.antennas, antennas, strict=True))
            antennas = (right, left)
        return Target(head, body, antennas)

    def action(self) -> dict[str, float]:
        """Return the parts by action key."""
        action: dict[str, float] = {}
        if self.head:
            action.update(zip(HEAD_KEYS, self.head.numbers(), strict=True))
        if self.body_yaw is not None:
            action["body_yaw"] = self.body_yaw
        if self.antennas:
            action["antenna_right"], action["antenna_left"] = self.antennas
        return action


def bounded(key: str, value: object, *, unit: str = "", scale: float = 1.0, name: str = "") -> float:
    """Return ``value`` in metres or radians, inside the bounds of an action key.

    Args:
        key: the action key.
        value: in the caller's unit.
        unit: name of the caller's unit, used with ``name`` in a refusal.
        scale: caller's units in a metre or radian.
        name: the caller's name for the key.
    """
    low, high = (bound * scale for bound in BOUNDS[key])
    label = f"{name or key} ({unit})" if unit else name or key
    # A conversion between degrees and radians may miss a bound by its last digit.
    slack = _ROUNDING * max(1.0, scale)
    value = plain_scalar(value)
    if isinstance(value, int | float) and not isinstance(value, bool) and low - slack <= value <= high + slack:
        return min(high, max(low, float(value))) / scale
    return number(label, value, low=round(low, 6), high=round(high, 6)) / scale


def check(target: Target, *, automatic_body_yaw: bool, body_yaw: float | None = None) -> Target:
    """Return ``target`` when the daemon can reach it as a whole.

    Raises:
        ValidationError: pitch and roll are too large together, or (only with automatic body yaw off, when the daemon
            does not turn the body along) head and body are turned more than 65 degrees apart. ``body_yaw`` is the
            body's position, used where the target names none.
    """
    head = target.head
    if head is not None and abs(head.pitch) + abs(head.roll) > TILT_SUM + _ROUNDING:
        tilt = math.degrees(abs(head.pitch) + abs(head.roll))
        raise ValidationError(f"pitch and roll must together be at most 60 degrees, not {tilt:g}.")
    body = target.body_yaw if target.body_yaw is not None else body_yaw
    if head is not None and body is not None and not automatic_body_yaw and abs(head.yaw - body) > NECK_YAW + _ROUNDING:
        apart = math.degrees(abs(head.yaw - body))
        raise ValidationError(
            f"head yaw and body yaw must be at most 65 degrees apart while automatic body yaw is off, not {apart:.4g}."
        )
    return target


def from_action(action: dict[str, object], start: Target) -> Target:
    """Return the target of an action; missing head numbers come from ``start``.

    Raises:
        ValidationError: an unknown key, an empty action, or a value out of its bounds.
    """
    if not isinstance(action, dict) or not action:
        raise ValidationError(f"action must be an object with keys of {', '.join(ACTION_KEYS)}.")
    if unknown := sorted(set(map(str, action)) - set(ACTION_KEYS)):
        raise ValidationError(f"action has no key {unknown[0]!r}; there are {', '.join(ACTION_KEYS)}.")
    values = {key: bounded(key, value) for key, value in action.items()}
    head = None
    if any(key in values for key in HEAD_KEYS):
        below = start.head or HeadPose()
        head = HeadPose(*(values.get(key, now) for key, now in zip(HEAD_KEYS, below.numbers(), strict=True)))
    antennas = None
    if "antenna_right" in values or "antenna_left" in values:
        right, left = start.antennas or INIT_ANTENNAS
        antennas = (values.get("antenna_right", right), values.get("antenna_left", left))
    return Target(head, values.get("body_yaw"), antennas)


Frames = Iterator[Target]
Gesture = Callable[[Target], Frames]
"""Makes the frames of a gesture from the present target, for a 50 Hz stream."""


def ramp(start: Target, end: Target) -> Frames:
    """Yield even steps of at most ``RAMP_STEP``; the last one is ``end`` itself."""
    frames = max(1, math.ceil(end.step_from(start) * FRAME_STEP / RAMP_STEP))
    for i in range(1, frames + 1):
        yield start.toward(end, i / frames)


def nod(start: Target) -> Frames:
    """Yield two nods about the present head pose."""
    head = start.head or HeadPose()
    centre = replace(head, roll=_within(head.roll, _CENTRE), pitch=_within(head.pitch, _CENTRE))
    yield from ramp(start, Target(centre))
    for swing in _swings(2, 0.8):
        yield Target(replace(centre, pitch=centre.pitch + _NOD * swing))


def shake(start: Target) -> Frames:
    """Yield two shakes about the present head pose."""
    head = start.head or HeadPose()
    centre = replace(head, yaw=_within(head.yaw, _SHAKE_CENTRE))
    yield from ramp(start, Target(centre))
    for swing in _swings(2, 0.8):
        yield Target(replace(centre, yaw=centre.yaw + _SHAKE * swing))


def happy(start: Target) -> Frames:
    """Yield three wiggles of the antennas against one another, about their rest."""
    right, left = INIT_ANTENNAS
    yield from ramp(start, Target(antennas=INIT_ANTENNAS))
    for swing in _swings(3, 0.5):
        yield Target(antennas=(right + _WIGGLE * swing, left - _WIGGLE * swing))


GESTURES: dict[str, Gesture] = {"nod": nod, "shake": shake, "happy": happy}


def _swings(times: int, period_s: float) -> Iterator[float]:
    """Yield a sine at the stream's rate that starts and ends at 0 without a jerk."""
    frames = round(times * period_s * STREAM_HZ)
    for i in range(1, frames + 1):
        share = i / frames
        yield math.sin(math.tau * times * share) * math.sin(math.pi * share)
    yield 0.0


def _within(value: float, bound: float) -> float:
    return max(-bound, min(bound, value))


def _dot(a: Sequence[float], b: Sequence[float]) -> float:
    return sum(p * q for p, q in zip(a, b, strict=True))
