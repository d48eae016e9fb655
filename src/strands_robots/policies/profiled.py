"""A policy as its profile describes it: order, units, speed, chunks in time.

A position counts the policy's own steps, of which there are ``rate`` in a second. It goes on only while an action is
played, so a robot that waits for its policy misses nothing of the path. A chunk begins at the position of its
observation: what was played while it was computed is stale and is never played.
"""

from __future__ import annotations

import logging
import math
import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any, Protocol, runtime_checkable

from strands_robots.policies.base import (
    Action,
    Policy,
    PolicyError,
    Ranges,
    Restartable,
    is_velocity,
    limited,
    numbers,
    speeds_across,
)
from strands_robots.policies.check import CONVERTIBLE, PolicyCheckError, RobotFacts, check_policy, statements_of
from strands_robots.policies.preload import Warmable, computing, require_warm
from strands_robots.policies.profiles import CameraMap, Profile
from strands_robots.safety.gate import MotionRefused
from strands_robots.utils import ValidationError, missing_extra, number, shown

LATENCIES = 10
"""Latencies of which the worst decides when to ask."""

_EXACT = 1e-6
"""Part of a step that is none: 50 Hz and 25 Hz meet at every second tick."""


class ChunkPlayer:
    """Position in a policy's steps, and the chunk that is played there.

    Args:
        rate: the policy's steps a second.
        hz: control steps a second, at least ``rate``; between two actions it interpolates.
        horizon: actions that are played of each chunk; None for all.
    """

    def __init__(self, *, rate: float, hz: float, horizon: int | None = None) -> None:
        self.position = 0.0
        self.stale = 0
        """Actions that came too late to be played."""
        self._rate = rate
        self._hz = hz
        self._horizon = horizon
        self._actions: Sequence[Action] = ()
        self._base = 0.0
        self._end = 0.0
        self._observed_at: float | None = None
        self._playing = False
        self._latencies: deque[float] = deque(maxlen=LATENCIES)

    @property
    def latency_s(self) -> float:
        """The worst of the last latencies; 0 before the first."""
        return max(self._latencies, default=0.0)

    @property
    def delay(self) -> int:
        """Steps that will be played before an answer that is asked for now has come."""
        return math.ceil(self.latency_s * self._rate - _EXACT)

    @property
    def played(self) -> int:
        """Actions of the present chunk that were played or are stale."""
        return min(len(self._actions), math.ceil(self.position - self._base - _EXACT))

    @property
    def left(self) -> float:
        """Steps until the chunk is over."""
        return self._end - self.position

    def advance(self, ticks: int = 1) -> None:
        """Go on by ``ticks`` control steps, more than one where some were missed."""
        if not self._playing:
            return
        self.position = min(self.position + ticks * self._rate / self._hz, self._end)
        if self._end - self.position < _EXACT:
            self.position = self._end
        self._playing = False

    def due(self, ahead: int = 0) -> bool:
        """Return True when it is time to ask, ``ahead`` control steps from now."""
        # One step more, because an answer is played at the control step after it came.
        lead = self.delay + (1 if self.latency_s > 0 else 0)
        if lead >= self._end - self._base:
            # The whole answer would be stale; the robot has to wait for it anyway.
            lead = 0
        return self.left - ahead * self._rate / self._hz <= lead + _EXACT

    def take(self, actions: Sequence[Action], asked_at: float, observed_at: float, latency_s: float) -> int:
        """Replace the chunk by one that was asked for at the position ``asked_at``.

        Returns the number of its actions that are stale.
        """
        self._latencies.append(latency_s)
        usable = len(actions) if self._horizon is None else min(len(actions), self._horizon)
        stale = min(usable, math.ceil(self.position - asked_at - _EXACT))
        self.stale += stale
        if stale < usable:
            self._actions, self._base, self._end = actions, asked_at, asked_at + usable
            self._observed_at = observed_at
        return stale

    def play(self) -> Action | None:
        """Return the action of this position, None where the chunk is over."""
        at = self.position - self._base
        if self.left < _EXACT or not self._actions:
            return None
        self._playing = True
        first = math.floor(at + _EXACT)
        part = at - first
        if part < _EXACT or first + 1 >= len(self._actions):
            return dict(self._actions[first])
        before, after = self._actions[first], self._actions[first + 1]
        return {key: value + part * (after[key] - value) for key, value in before.items()}

    def age_s(self, now: float) -> float:
        """Return the age of the observation that the present chunk answers, in seconds."""
        return 0.0 if self._observed_at is None else now - self._observed_at

    def clear(self) -> None:
        """Drop the chunk."""
        self._actions, self._end = (), self.position
        self._playing = False


logger = logging.getLogger(__name__)

Infer = Callable[[Any], Any]
"""Computes the answer to one request; may take long, and may raise."""


@dataclass(frozen=True)
class InferenceResult:
    """The answer to a request, or what was raised instead, and how long it took."""

    value: Any
    failure: BaseException | None
    latency_s: float


class Inference(Protocol):
    """Asks a model; no call waits for it."""

    def ask(self, request: Any) -> None:
        """Ask; there must be no request in flight."""

    def answer(self) -> InferenceResult | None:
        """Return the answer, once, when it is there."""

    @property
    def waited_s(self) -> float | None:
        """Seconds since the request in flight, None without one."""

    def close(self) -> None:
        """Drop the request in flight and its answer."""


class InferenceWorker:
    """Inference on a thread of its own, which begins with the first request.

    Args:
        name: named in the thread and in the log.
        infer: called on the thread.
        finish: called once when no inference runs any more, as the last thing: it may free the model.
    """

    def __init__(self, name: str, infer: Infer, finish: Callable[[], None]) -> None:
        self._name = name
        self._infer = infer
        self._finish = finish
        self._asked_at: float | None = None
        self._requests: queue.SimpleQueue[tuple[Any] | None] = queue.SimpleQueue()
        self._answers: queue.SimpleQueue[InferenceResult] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None
        self._closed = False

    def ask(self, request: Any) -> None:
        if self._closed:
            return
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name=f"inference-{self._name}", daemon=True)
            self._thread.start()
        self._asked_at = time.monotonic()
        self._requests.put((request,))

    def answer(self) -> InferenceResult | None:
        try:
            answer = self._answers.get_nowait()
        except queue.Empty:
            return None
        self._asked_at = None
        return None if self._closed else answer

    @property
    def waited_s(self) -> float | None:
        return None if self._asked_at is None else time.monotonic() - self._asked_at

    def close(self) -> None:
        """Drop the request in flight; the model is freed once it has returned."""
        if self._closed:
            return
        self._closed = True
        if self._thread is None:
            self._finish()
            return
        waited = self.waited_s
        if waited is not None:
            logger.info("The policy %s has been computing for %.1f s; its answer is dropped.", self._name, waited)
        self._requests.put(None)

    def _run(self) -> None:
        try:
            while (request := self._requests.get()) is not None and not self._closed:
                began = self._asked_at if self._asked_at is not None else time.monotonic()
                value, failure = None, None
                try:
                    with computing(f"The inference of the policy {self._name}"):
                        value = self._infer(request[0])
                except BaseException as exc:  # noqa: BLE001 - raised again in the control thread
                    failure = exc
                self._answers.put(InferenceResult(value, failure, time.monotonic() - began))
        finally:
            self._finish()


class InlineInference:
    """Inference in the calling thread, for a clock that is moved by hand.

    Args:
        infer: called by :meth:`ask`.
        finish: called by :meth:`close`.
        now: time in seconds.
        latency_s: seconds of that time after which an answer is there.
    """

    def __init__(
        self, infer: Infer, finish: Callable[[], None], now: Callable[[], float], latency_s: float = 0.0
    ) -> None:
        self._infer = infer
        self._finish = finish
        self._now = now
        self._latency_s = latency_s
        self._asked_at: float | None = None
        self._answer: InferenceResult | None = None
        self._closed = False

    def ask(self, request: Any) -> None:
        self._asked_at = self._now()
        value, failure = None, None
        try:
            value = self._infer(request)
        except Exception as exc:  # noqa: BLE001 - raised again where the answer is fetched
            failure = exc
        self._answer = InferenceResult(value, failure, self._latency_s)

    def answer(self) -> InferenceResult | None:
        if self._asked_at is None or self._now() - self._asked_at < self._latency_s - 1e-9:
            return None
        answer, self._answer, self._asked_at = self._answer, None, None
        return answer

    @property
    def waited_s(self) -> float | None:
        return None if self._asked_at is None else self._now() - self._asked_at

    def close(self) -> None:
        self._answer = self._asked_at = None
        if not self._closed:
            self._closed = True
            self._finish()


UNBOUNDED_PER_S = 10.0
"""Speed bound of a key without a range, in its unit a second."""

LOAD_POLL_S = 0.05

GRACE_S = 0.1
"""Seconds beyond the deadline in which a provider may say by itself why it did not answer."""


COUNTED_LATENCIES = 1000
"""Latencies of which the quantiles are taken."""


@dataclass
class LoopCounts:
    """Counts of one rollout; times in seconds.

    Attributes:
        inferences: answers that came.
        underruns: how often no action was there in time; ``underrun_steps`` has the control steps without one.
        stale_actions: actions that came too late to be played.
        speed_limited_steps: steps that the profile's ``max_speed`` held back.
        chunk_age_s: age of the observation behind the last action; ``chunk_age_max_s`` the greatest.
    """

    inferences: int = 0
    underruns: int = 0
    underrun_steps: int = 0
    stale_actions: int = 0
    speed_limited_steps: int = 0
    chunk_age_s: float = 0.0
    chunk_age_max_s: float = 0.0
    latencies: deque[float] = field(default_factory=lambda: deque(maxlen=COUNTED_LATENCIES))

    def answered(self, latency_s: float) -> None:
        """Count an answer."""
        self.inferences += 1
        self.latencies.append(latency_s)

    def aged(self, seconds: float) -> None:
        """Note the age of the chunk that an action was taken of."""
        self.chunk_age_s = seconds
        self.chunk_age_max_s = max(self.chunk_age_max_s, seconds)

    def as_dict(self) -> dict[str, float]:
        """Return the figures by name."""
        ordered = sorted(self.latencies) or [0.0]
        return {
            "inferences": self.inferences,
            "latency_ms": round(1000 * (self.latencies[-1] if self.latencies else 0.0), 2),
            "latency_p50_ms": round(1000 * _quantile(ordered, 0.5), 2),
            "latency_p99_ms": round(1000 * _quantile(ordered, 0.99), 2),
            "latency_max_ms": round(1000 * ordered[-1], 2),
            "chunk_age_s": round(self.chunk_age_s, 3),
            "chunk_age_max_s": round(self.chunk_age_max_s, 3),
            "underruns": self.underruns,
            "underrun_steps": self.underrun_steps,
            "stale_actions": self.stale_actions,
            "speed_limited_steps": self.speed_limited_steps,
        }


def _quantile(ordered: list[float], share: float) -> float:
    return ordered[min(len(ordered) - 1, int(share * len(ordered)))]


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
    :meth:`act`, which never waits, plays the last chunk: see :class:`ChunkPlayer`. An inner policy with ``every_tick``
    true, which needs every observation, computes in :meth:`act`.

    Args:
        profile: describes the policy.
        inner: decides the actions, in its own units.
    """

    def __init__(self, profile: Profile, inner: Policy) -> None:
        self.profile = profile
        self.uses_cameras = bool(profile.cameras)
        self.preparing = True
        """True until the first chunk has come; the robot has not moved yet."""
        self._inner = inner
        self._now: Callable[[], float] = time.monotonic
        self._scale: dict[str, float] = {}
        self._unanswered_logged = False
        self._speeds: dict[str, float] = {}
        self._last: Action = {}
        self._hz = profile.rate or 0.0
        self._inference: Inference = InferenceWorker(profile.name, self._infer, inner.close)
        if getattr(inner, "every_tick", False):
            self.compute_inline()
        self._player = ChunkPlayer(rate=1.0, hz=1.0)
        self._asked: tuple[float, float] = (0.0, 0.0)
        self._counts = LoopCounts()
        self._missed = 0
        self._dry = False
        self._done = False
        self._anew = self._outdated = False
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
        if found.unanswered and not self._unanswered_logged:
            self._unanswered_logged = True
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
        scales = {key: self._scale[key] for key in profile.action}
        inner = {key: (ranges[key][0] * scale, ranges[key][1] * scale) for key, scale in scales.items()}
        fastest = profile.max_speed
        self._speeds = {} if fastest is None else speeds_across(ranges, fastest, UNBOUNDED_PER_S)
        self._last = {}
        horizon = 1 if getattr(self._inner, "every_tick", False) else profile.horizon
        self._player = ChunkPlayer(rate=profile.rate or self._hz, hz=self._hz, horizon=horizon)
        self._inner.reset(profile.task or instruction, inner)

    def act(self, observation: Mapping[str, Any]) -> Action | tuple[()] | None:
        """Return the action of this step, nothing while there is none, None at the end.

        Raises:
            PolicyError: the inner policy failed, or did not answer within the deadline of its profile.
        """
        if self._interrupted.is_set():
            return ()
        now, player = self._now(), self._player
        player.advance(1 + self._missed)
        self._missed = 0
        self._take(observation)
        if self._inference.waited_s is None and not self._done and player.due():
            self._ask(observation, now)
            self._take(observation)
        action = player.play()
        self.uses_cameras = bool(self.profile.cameras) and self._inference.waited_s is None and player.due(ahead=1)
        if action is None:
            return None if self._done else self._keep_place()
        self._dry = False
        self._counts.aged(player.age_s(now))
        return self._limited(action)

    def restart(self) -> None:
        """Drop the chunk, and the answer under way."""
        self._player.clear()
        self._last = {}
        self._anew = True
        self._outdated = self._inference.waited_s is not None
        self.uses_cameras = bool(self.profile.cameras)

    def miss(self, ticks: int) -> None:
        """Skip the actions of control steps that came too late to be made."""
        self._missed += ticks

    def counts(self) -> dict[str, float]:
        """Return the figures of the loop, as :class:`LoopCounts` names them."""
        return {**self._counts.as_dict(), "stale_actions": self._player.stale}

    def interrupt(self) -> None:
        self._interrupted.set()
        self._inner.interrupt()

    def close(self) -> None:
        self._inference.close()
        self._player.clear()

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
        self._asked = (self._player.position, now)
        anew, self._anew = self._anew, False
        self._inference.ask((seen, pictures, self._player.played, self._player.delay, anew))

    def _infer(self, request: tuple[dict[str, Any], dict[CameraMap, object], int, int, bool]) -> list[Action] | None:
        """Return the chunk for a request, in the robot's units."""
        seen, pictures, played, delay, anew = request
        if anew and isinstance(self._inner, Restartable):
            # On the thread that computes: nothing else of the model runs now.
            self._inner.restart()
        for camera, given in pictures.items():
            seen[camera.short_key] = picture(camera, given)
        if isinstance(self._inner, RealTimeChunking) and self._inner.continues and not anew:
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
        outdated, self._outdated = self._outdated, False
        if outdated:
            return
        self.preparing = False
        if answer.value is None:
            self._done = True
        elif answer.value:
            present = numbers(observation)
            self._last = self._last or {key: present[key] for key in self.profile.action if key in present}
            self._player.take(answer.value, *self._asked, answer.latency_s)

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
        bounded = limited(target, self._last, self._speeds, 1 / self._hz)
        self._counts.speed_limited_steps += bounded != target
        self._last = bounded
        return bounded


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
