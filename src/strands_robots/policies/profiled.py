"""A policy as its profile describes it: order, units, pictures and speed bound."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from importlib import import_module
from typing import Any

from strands_robots.policies.base import Action, Policy, PolicyError, Ranges, SpeedLimit, numbers
from strands_robots.policies.check import CONVERTIBLE, PolicyCheckError, RobotFacts, check_policy, statements_of
from strands_robots.policies.profiles import CameraMap, Profile
from strands_robots.policies.warm import Warmable, require_warm
from strands_robots.utils import ValidationError, missing_extra, number, shown

UNBOUNDED_PER_S = 10.0
"""Speed bound of a key without a range, in its unit a second."""


class ProfiledPolicy:
    """Policy that sees and says what its profile names, in that order and no other.

    The inner policy gets the state keys of the profile in its order and unit, and pictures by their keys; it answers
    with actions of exactly the profile's keys, or chunks of them.

    Args:
        profile: describes the policy.
        inner: decides the actions, in its own units.
    """

    def __init__(self, profile: Profile, inner: Policy) -> None:
        self.profile = profile
        self.uses_cameras = bool(profile.cameras)
        self._inner = inner
        self._scale: dict[str, float] = {}
        self._limit: SpeedLimit | None = None
        self._last: Action = {}
        self._dt = 0.0

    def warm(self) -> None:
        """Begin to load the policy, if it takes long."""
        if isinstance(self._inner, Warmable):
            self._inner.warm()

    def fit(self, robot: RobotFacts) -> None:
        """Check the policy against a robot, before anything moves.

        Raises:
            PolicyCheckError: something is refused or unverified.
            MotionRefused: the policy is not loaded yet.
        """
        found = check_policy(self.profile, statements_of(self.profile), robot)
        if not found.passed:
            raise PolicyCheckError(found)
        keys = {*self.profile.state, *self.profile.action}
        self._scale = {key: _scale(robot.units.get(key), self.profile.unit(key)) for key in keys}
        self._dt = 1 / (self.profile.rate or robot.rate)
        require_warm(self._inner, self.profile.name)

    def reset(self, instruction: str, ranges: Ranges) -> None:
        profile = self.profile
        inner = {key: _scaled_range(ranges[key], self._scale[key]) for key in profile.action}
        self._limit = None if profile.max_speed is None else SpeedLimit(ranges, profile.max_speed, UNBOUNDED_PER_S)
        self._last = {}
        self._inner.reset(profile.task or instruction, inner)

    def act(self, observation: Mapping[str, Any]) -> list[Action] | None:
        present = numbers(observation)
        lacking = [key for key in self.profile.state if key not in present]
        if lacking:
            raise PolicyError(f"the robot gives no number for {', '.join(lacking)}")
        seen: dict[str, Any] = {key: present[key] * self._scale[key] for key in self.profile.state}
        for camera in self.profile.cameras:
            seen[camera.key.removeprefix("observation.images.")] = picture(camera, observation.get(camera.camera))
        answer = self._inner.act(seen)
        if answer is None:
            return None
        chunk: Sequence[Action] = [answer] if isinstance(answer, Mapping) else answer
        self._last = self._last or {key: present[key] for key in self.profile.action if key in present}
        return [self._action(action) for action in chunk[: self.profile.horizon]]

    def interrupt(self) -> None:
        self._inner.interrupt()

    def close(self) -> None:
        self._inner.close()

    def _action(self, action: object) -> Action:
        if not isinstance(action, Mapping) or set(action) != set(self.profile.action):
            keys = sorted(map(str, action)) if isinstance(action, Mapping) else shown(action)
            raise PolicyError(f"the policy answered {keys}, and its profile names {', '.join(self.profile.action)}")
        try:
            target = {key: number(f"action[{key!r}]", action[key]) / self._scale[key] for key in self.profile.action}
        except ValidationError as exc:
            raise PolicyError(str(exc)) from None
        if self._limit is not None:
            target = self._limit.limit(target, self._last, self._dt)
        self._last = target
        return target


def picture(camera: CameraMap, given: object) -> Any:
    """Return a camera's picture as the policy wants it: (height, width, 3), uint8.

    Raises:
        PolicyError: it is none, or of another shape.
        MissingExtraError: it has to be resized, and Pillow is not installed.
    """
    shape = tuple(getattr(given, "shape", ()))
    if len(shape) != 3 or shape[2] != 3 or str(getattr(given, "dtype", "")) != "uint8":
        raise PolicyError(f"camera {camera.camera} must give height x width x 3 bytes, not {shape or shown(given)}")
    numpy = import_module("numpy")
    image: Any = given
    if camera.crop is not None:
        x, y, width, height = camera.crop
        image = image[y : y + height, x : x + width]
    if camera.flip in ("180", "vertical"):
        image = image[::-1]
    if camera.flip in ("180", "horizontal"):
        image = image[:, ::-1]
    image = numpy.ascontiguousarray(image)
    if camera.size is not None and image.shape[:2] != camera.size:
        try:
            pillow = import_module("PIL.Image")
        except ModuleNotFoundError as exc:
            raise missing_extra("Resizing pictures", "record") from exc
        height, width = camera.size
        image = numpy.asarray(pillow.fromarray(image).resize((width, height), pillow.Resampling.BILINEAR))
    return image


def _scale(robot: str | None, policy: str | None) -> float:
    """Return the factor from the robot's unit to the policy's."""
    if robot == policy or robot is None or policy is None or not {robot, policy} <= CONVERTIBLE:
        return 1.0
    return math.degrees(1.0) if policy == "degrees" else math.radians(1.0)


def _scaled_range(pair: tuple[float, float], scale: float) -> tuple[float, float]:
    return pair[0] * scale, pair[1] * scale
