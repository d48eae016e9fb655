"""A policy as its profile describes it: order, units, pictures and speed bound."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from typing import Any, Protocol, runtime_checkable

from strands_robots.policies.base import Action, Policy, PolicyError, Ranges, SpeedLimit, is_velocity, numbers
from strands_robots.policies.check import CONVERTIBLE, PolicyCheckError, check_policy, statements_of
from strands_robots.policies.check_rows import RobotFacts
from strands_robots.policies.inference import Inference, InferenceWorker, InlineInference
from strands_robots.policies.loop_counts import LoopCounts
from strands_robots.policies.playback import Playback
from strands_robots.policies.profiles import CameraMap, Profile
from strands_robots.policies.warm import Warmable, require_warm
from strands_robots.safety.gate import MotionRefused
from strands_robots.utils import ValidationError, missing_extra, number, shown

logger = logging.getLogger(__name__)

UNBOUNDED_PER_S = 10.0
"""Speed bound of a key without a range, in its unit a second."""

LOAD_POLL_S = 0.05

GRACE_S = 0.1
"""Seconds beyond the deadline in which a provider may say by itself why it did not answer."""


@runtime_checkable
class RealTimeChunking(Protocol):
    """Policy that makes a chunk go on from its last one, so that there is no seam."""

    continues: bool
    """False where this one does not."""

    def act_on(self, observation: Mapping[str, Any], *, played: int, delay: int) -> Sequence[Action] | None:
        """Return the next chunk.

        Args:
            observation: as :meth:`Policy.act` gets it.
            played: actions of its last answer that are played or stale by now; 0 before the first.
            delay: steps of the last answer that will be played before this one has come.
        """


class ProfiledPolicy:
    """Policy that sees and says what its profile names, in that order and no other.

    The inner policy gets the state keys of the profile in its order and unit, and pictures by their keys; it answers
    with actions of exactly the profile's keys, or chunks of them. It computes on a thread of its own while
    :meth:`act`, which never waits, plays the last chunk: see :class:`Playback`. An inner policy with ``every_tick``
    true, which needs every observation, computes in :meth:`act`.

    Args:
        profile: describes the policy.
        inner: decides the actions, in its own units.
    """

    def __init__(
        self,
        profile: Profile,
        inner: Policy,
    ) -> None:
        self.profile = profile
        self.uses_cameras = bool(profile.cameras)
        self.preparing = True
        """True until the first chunk has come; the robot has not moved yet."""
        self._inner = inner
        self._now: Callable[[], float] = time.monotonic
        self._scale: dict[str, float] = {}
        self._told = False
        self._limit: SpeedLimit | None = None
        self._last: Action = {}
        self._hz = profile.rate or 0.0
        self._inference: Inference = InferenceWorker(profile.name, self._infer, inner.close)
        if getattr(inner, "every_tick", False):
            self.compute_inline()
        self._playback = Playback(rate=1.0, hz=1.0)
        self._asked: tuple[float, float] = (0.0, 0.0)
        self._counts = LoopCounts()
        self._missed = 0
        self._dry = False
        self._done = False
        self._interrupted = threading.Event()

    def compute_inline(self, now: Callable[[], float] = time.monotonic, latency_s: float = 0.0) -> None:
        """Compute in :meth:`act`, as a clock that is moved by hand needs it.

        Args:
            now: that clock, in seconds.
            latency_s: time of that clock after which an answer is there.
        """
        self._now = now
        self._inference = InlineInference(self._infer, self._inner.close, now, latency_s)

    def warm(self) -> str | None:
        """Begin to load the policy, if it takes long; see :class:`Warmable`."""
        return self._inner.warm() if isinstance(self._inner, Warmable) else None

    def fit(self, robot: RobotFacts) -> None:
        """Check the policy against a robot, before anything moves.

        Raises:
            PolicyCheckError: something is refused or unverified.
            MotionRefused: the policy is not loaded yet.
        """
        found = check_policy(self.profile, statements_of(self.profile), robot)
        if not found.passed:
            raise PolicyCheckError(found)
        if found.unanswered and not self._told:
            self._told = True
            questions = ", ".join(dict.fromkeys(row.question for row in found.unanswered))
            logger.warning("%s moves %s, and no source states: %s.", self.profile.name, robot.name, questions)
        keys = {*self.profile.state, *self.profile.environment, *self.profile.action}
        self._scale = {key: _scale(robot.units.get(key), self.profile.unit(key)) for key in keys}
        self._hz = robot.rate
        require_warm(self._inner, self.profile.name)

    def load(self, robot: RobotFacts, within: float) -> None:
        """Check the policy against a robot, and wait until it is loaded.

        Raises:
            ValidationError: it does not fit.
            PolicyError: it could not be loaded ``within`` seconds.
        """
        deadline = time.monotonic() + within
        while True:
            try:
                self.fit(robot)
            except MotionRefused as refused:
                if not refused.envelope.get("loading") or time.monotonic() > deadline:
                    raise PolicyError(str(refused.envelope["reason"])) from None
                time.sleep(LOAD_POLL_S)
            else:
                return

    def reset(self, instruction: str, ranges: Ranges) -> None:
        profile = self.profile
        inner = {key: _scaled_range(ranges[key], self._scale[key]) for key in profile.action}
        self._limit = None if profile.max_speed is None else SpeedLimit(ranges, profile.max_speed, UNBOUNDED_PER_S)
        self._last = {}
        horizon = 1 if getattr(self._inner, "every_tick", False) else profile.horizon
        self._playback = Playback(rate=profile.rate or self._hz, hz=self._hz, horizon=horizon)
        self._inner.reset(profile.task or instruction, inner)

    def act(self, observation: Mapping[str, Any]) -> Action | tuple[()] | None:
        """Return the action of this step, nothing while there is none, None at the end.

        Raises:
            PolicyError: the inner policy failed, or did not answer within the deadline of its profile.
        """
        if self._interrupted.is_set():
            return ()
        now, playback = self._now(), self._playback
        playback.advance(1 + self._missed)
        self._missed = 0
        self._take(observation)
        if self._inference.waited_s is None and not self._done and playback.due():
            self._ask(observation, now)
            self._take(observation)
        action = playback.play()
        self.uses_cameras = bool(self.profile.cameras) and self._inference.waited_s is None and playback.due(ahead=1)
        if action is None:
            return None if self._done else self._keep_place()
        self._dry = False
        self._counts.aged(playback.age_s(now))
        return self._limited(action)

    def miss(self, ticks: int) -> None:
        """Skip the actions of control steps that came too late to be made."""
        self._missed += ticks

    def counts(self) -> dict[str, float]:
        """Return the figures of the loop, as :class:`LoopCounts` names them."""
        return {**self._counts.as_dict(), "stale_actions": self._playback.stale}

    def interrupt(self) -> None:
        self._interrupted.set()
        self._inner.interrupt()

    def close(self) -> None:
        self._inference.close()
        self._playback.clear()

    def _ask(self, observation: Mapping[str, Any], now: float) -> None:
        profile = self.profile
        present = numbers(observation)
        lacking = [key for key in (*profile.state, *profile.environment) if key not in present]
        if lacking:
            raise PolicyError(f"the robot gives no number for {', '.join(lacking)}")
        if profile.cameras and not self.uses_cameras:
            # This control step was begun without pictures; the next one has them.
            return
        seen: dict[str, Any] = {key: present[key] * self._scale[key] for key in (*profile.state, *profile.environment)}
        pictures = {camera: observation.get(camera.camera) for camera in profile.cameras}
        self._asked = (self._playback.position, now)
        self._inference.ask((seen, pictures, self._playback.played, self._playback.delay))

    def _infer(self, request: tuple[dict[str, Any], dict[CameraMap, object], int, int]) -> list[Action] | None:
        """Return the chunk for a request, in the robot's units."""
        seen, pictures, played, delay = request
        for camera, given in pictures.items():
            seen[camera.key.removeprefix("observation.images.")] = picture(camera, given)
        if isinstance(self._inner, RealTimeChunking) and self._inner.continues:
            answer: object = self._inner.act_on(seen, played=played, delay=delay)
        else:
            answer = self._inner.act(seen)
        if answer is None:
            return None
        chunk = [answer] if isinstance(answer, Mapping) or not isinstance(answer, Sequence) else answer
        return [self._action(action) for action in chunk]

    def _take(self, observation: Mapping[str, Any]) -> None:
        """Take the answer, if it is there, for the next chunk."""
        answer = self._inference.answer()
        if answer is None:
            waited = self._inference.waited_s
            if waited is not None and waited > self.profile.deadline_s + GRACE_S:
                raise PolicyError(
                    f"the inference of {self.profile.name} has not answered for {waited:.1f} s; its deadline_s is "
                    f"{self.profile.deadline_s:g}"
                )
            return
        if answer.failure is not None:
            raise answer.failure
        self._counts.answered(answer.latency_s)
        self.preparing = False
        if answer.value is None:
            self._done = True
        elif answer.value:
            present = numbers(observation)
            self._last = self._last or {key: present[key] for key in self.profile.action if key in present}
            self._playback.take(answer.value, *self._asked, answer.latency_s)

    def _keep_place(self) -> Action | tuple[()]:
        """Count a step without an action; a velocity is told to be zero."""
        if self.preparing:
            return ()
        self._counts.underrun_steps += 1
        if self._dry:
            return ()
        self._dry = True
        self._counts.underruns += 1
        if self._counts.underruns == 1:
            name = self.profile.name
            logger.warning("The policy %s had no action in time; the robot keeps its place. More are counted.", name)
        return {key: 0.0 for key in self._last if is_velocity(key)} or ()

    def _action(self, action: object) -> Action:
        if not isinstance(action, Mapping) or set(action) != set(self.profile.action):
            keys = sorted(map(str, action)) if isinstance(action, Mapping) else shown(action)
            raise PolicyError(f"the policy answered {keys}, and its profile names {', '.join(self.profile.action)}")
        try:
            return {key: number(f"action[{key!r}]", action[key]) / self._scale[key] for key in self.profile.action}
        except ValidationError as exc:
            raise PolicyError(str(exc)) from None

    def _limited(self, target: Action) -> Action:
        if self._limit is not None:
            limited = self._limit.limit(target, self._last, 1 / self._hz)
            self._counts.speed_limited_steps += limited != target
            target = limited
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
