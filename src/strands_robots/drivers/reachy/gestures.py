"""Motions that the driver makes itself, as frames for a 50 Hz stream. Metres and radians."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

from strands_robots.drivers.reachy.envelope import FRAME_STEP, INIT_ANTENNAS, RAMP_STEP, STREAM_HZ, Target
from strands_robots.drivers.reachy.pose import HeadPose

Frames = Iterator[Target]
Gesture = Callable[[Target], Frames]
"""Frames of a gesture, given where the robot is."""

# Room for a gesture on top of a tilted head: 20 + 20 + 15 degrees stay below the 60 of pitch and roll together.
_CENTRE = math.radians(20)
_NOD, _SHAKE, _WIGGLE = math.radians(15), math.radians(20), math.radians(35)
_HEAD_YAW = math.radians(150)


def ramp(start: Target, end: Target) -> Frames:
    """Even steps of at most ``RAMP_STEP`` radians a frame; ``end`` itself is the last one."""
    frames = max(1, math.ceil(end.step_from(start) * FRAME_STEP / RAMP_STEP))
    for i in range(1, frames + 1):
        yield start.toward(end, i / frames)


def nod(start: Target) -> Frames:
    """Twice down and up, about where the head is."""
    head = start.head or HeadPose()
    centre = HeadPose(head.x, head.y, head.z, _within(head.roll, _CENTRE), _within(head.pitch, _CENTRE), head.yaw)
    yield from ramp(start, Target(centre))
    for swing in _swings(2, 0.8):
        yield Target(HeadPose(centre.x, centre.y, centre.z, centre.roll, centre.pitch + _NOD * swing, centre.yaw))


def shake(start: Target) -> Frames:
    """Twice left and right, about where the head is."""
    head = start.head or HeadPose()
    centre = HeadPose(head.x, head.y, head.z, head.roll, head.pitch, _within(head.yaw, _HEAD_YAW))
    yield from ramp(start, Target(centre))
    for swing in _swings(2, 0.8):
        yield Target(HeadPose(centre.x, centre.y, centre.z, centre.roll, centre.pitch, centre.yaw + _SHAKE * swing))


def happy(start: Target) -> Frames:
    """The antennas wiggle against one another three times, about their rest."""
    right, left = INIT_ANTENNAS
    yield from ramp(start, Target(antennas=INIT_ANTENNAS))
    for swing in _swings(3, 0.5):
        yield Target(antennas=(right + _WIGGLE * swing, left - _WIGGLE * swing))


def _swings(times: int, period_s: float) -> Iterator[float]:
    """A sine from 0 to 0, sampled at the stream's rate, that starts and ends without a jerk."""
    frames = round(times * period_s * STREAM_HZ)
    for i in range(1, frames + 1):
        share = i / frames
        yield math.sin(math.tau * times * share) * math.sin(math.pi * share)
    yield 0.0


def _within(value: float, bound: float) -> float:
    return max(-bound, min(bound, value))
