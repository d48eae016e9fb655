"""The policy protocol, the check of actions, and a policy without a model."""

from __future__ import annotations

import hashlib
import logging
import math
import random
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, runtime_checkable

from strands_robots.errors import StrandsRobotsError
from strands_robots.moved import of_module
from strands_robots.utils import ValidationError, mapping, number, shown, whole

if not TYPE_CHECKING:
    __path__, __getattr__ = of_module(__name__)


Action = dict[str, float]
"""Targets by action key, in the robot's own units."""

Ranges = Mapping[str, tuple[float, float]]
"""Lowest and highest target of every action key of a body; infinite where the body declares none."""


LEADER_UNBOUNDED_PER_S = 1440.0
"""Speed bound of a leader for a joint without a range, in its unit a second (two turns a second in degrees, twice)."""


class PolicyError(StrandsRobotsError, RuntimeError):
    """A policy cannot go on; the message is logged without a traceback."""


@runtime_checkable
class Policy(Protocol):
    """Source of a robot's actions; one object serves one rollout, on its thread.

    A policy that does not do what the instruction says has ``follows_instruction = False`` besides.
    """

    @property
    def uses_cameras(self) -> bool:
        """False for a policy of numbers alone, which works while a camera fails."""

    def reset(self, instruction: str, ranges: Ranges) -> None:
        """Prepare for a task: load, connect, seed. Raises when that is impossible."""

    def act(self, observation: Mapping[str, Any]) -> Action | Sequence[Action] | None:
        """Return an action, a chunk played one a control step, or None when done.

        An empty chunk lets this control step pass without a command. Only numbers under the robot's own action keys
        are accepted; anything else ends the rollout with an error, and the body keeps its last position.
        """

    def interrupt(self) -> None:
        """Make ``reset`` or ``act`` give up. Called from another thread; never waits."""

    def close(self) -> None:
        """Free the policy's resources. Called once, also after a failed reset."""


@runtime_checkable
class Paced(Protocol):
    """Policy that plays chunks in time with the control loop."""

    @property
    def preparing(self) -> bool:
        """True until it has its first action: the duration of the task has not begun yet."""

    def miss(self, ticks: int) -> None:
        """Skip the actions of control steps that came too late to be made."""


@runtime_checkable
class Counted(Protocol):
    """Policy that counts what its loop did."""

    def counts(self) -> Mapping[str, float]:
        """Return the figures by name, as events, status and recordings have them."""


@runtime_checkable
class Restartable(Protocol):
    """Policy that can forget what it has planned, without a wait."""

    def restart(self) -> None:
        """Drop the plan and each answer under way; begin from the next observation."""


class TurnOfDriver(NamedTuple):
    """Driver of a robot in turns.

    Attributes:
        state: policy, led or held.
        leader: its name.
        why: reason of a hold; else empty.
    """

    state: str
    leader: str
    why: str = ""


@runtime_checkable
class Led(Protocol):
    """Policy that a leader may take over."""

    led_by: str
    """The leader that has taken over; empty while none has."""

    turn: TurnOfDriver
    """Driver of the last control step."""

    reach: Ranges
    """The body's ranges, out to a joint that stands beyond them: to hold it there must not move it."""

    def hold(self, why: str) -> None:
        """Let nobody drive until the next turn; returns at once."""


@runtime_checkable
class Noting(Protocol):
    """Policy that is told what came of its actions."""

    def wrote(self, action: Mapping[str, float]) -> None:
        """Note what was really written, on the control thread."""


def checked_action(action: object, ranges: Ranges) -> Action:
    """Return ``action`` with every value clamped to the range of its key.

    Raises:
        ValidationError: not a mapping, an unknown key, or a value that is no finite number.
    """
    checked: Action = {}
    for key, value in mapping("action", action).items():
        if key not in ranges:
            raise ValidationError(f"action has no key {shown(key)}; the robot has {', '.join(ranges)}.")
        low, high = ranges[key]
        # Numbers of the standard library need no look: this runs at every control step.
        finite = value if type(value) is float and math.isfinite(value) else number(f"action[{key!r}]", _plain(value))
        checked[key] = min(max(finite, low), high)
    return checked


class Observation(Mapping[str, Any]):
    """Numbers of a robot, and pictures that are drawn when they are first read.

    Args:
        joints: the numbers, by key.
        pictures: draws each picture as it was when the numbers were read, by camera.
    """

    def __init__(self, joints: Mapping[str, float], pictures: Mapping[str, Callable[[], Any]]) -> None:
        self.joints = dict(joints)
        self._pictures = dict(pictures)
        self._drawn: dict[str, Any] = {}

    def __getitem__(self, key: str) -> Any:
        if key in self.joints:
            return self.joints[key]
        if key not in self._drawn:
            self._drawn[key] = self._pictures[key]()
        return self._drawn[key]

    def __iter__(self) -> Iterator[str]:
        yield from self.joints
        yield from self._pictures

    def __len__(self) -> int:
        return len(self.joints) + len(self._pictures)


def numbers(observation: Mapping[str, object]) -> dict[str, float]:
    """Return the finite numbers of an observation, without images, flags and text."""
    finite: dict[str, float] = {}
    # To look at the pictures would draw them.
    plain = observation.joints if isinstance(observation, Observation) else observation
    for key, value in plain.items():
        scalar = value if type(value) is float else _plain(value)
        if isinstance(scalar, int | float) and not isinstance(scalar, bool) and abs(scalar) <= sys.float_info.max:
            finite[key] = float(scalar)
    return finite


def plain_numbers(values: object) -> dict[str, float]:
    """Return the finite numbers of a mapping; ``{"position": x}`` counts as ``x``."""
    if not isinstance(values, Mapping):
        return {}
    return numbers(
        {str(name): value.get("position") if isinstance(value, Mapping) else value for name, value in values.items()}
    )


def is_velocity(key: str) -> bool:
    """Return True for an action key that is a velocity."""
    return key.endswith((".vel", "_vel", ".velocity"))


def _plain(value: object) -> object:
    """Unwrap a scalar of an array package; return anything else unchanged."""
    item = getattr(value, "item", None)
    return item() if callable(item) and getattr(value, "ndim", None) == 0 else value


JOINT_SPEED_RAD_S = 2.0
"""Greatest speed of a joint of a real arm, unless its robot is given another."""

SPEED_MAX = 1e6


def checked_speeds(value: object, keys: Iterable[str]) -> dict[str, float]:
    """Return a speed limit by action key: a number for all ``keys``, or some by name.

    Raises:
        ValidationError: an unknown key, or a speed that is not above 0 and at most 1,000,000.
    """
    known = list(keys)
    given = mapping("speed_limit", value) if isinstance(value, Mapping) else dict.fromkeys(known, value)
    for key in given:
        if key not in known:
            raise ValidationError(f"speed_limit has no key {shown(key)}; the robot has {', '.join(known)}.")
    named = isinstance(value, Mapping)
    return {
        key: number(f"speed_limit[{key!r}]" if named else "speed_limit", per_s, above=0, high=SPEED_MAX)
        for key, per_s in given.items()
    }


def speeds_across(ranges: Ranges, full_ranges_per_s: float, unbounded_per_s: float) -> dict[str, float]:
    """Return speeds by key: its range so often a second, or one without a range.

    Args:
        full_ranges_per_s: above 0.
        unbounded_per_s: in the key's unit a second.
    """
    return {
        key: (high - low) * full_ranges_per_s if math.isfinite(high - low) else unbounded_per_s
        for key, (low, high) in ranges.items()
    }


def limited(target: Action, last: Mapping[str, float], speeds: Mapping[str, float], dt: float) -> Action:
    """Return ``target``, moved no further from ``last`` than ``dt`` seconds allow.

    Args:
        speeds: greatest speed by key, in its unit a second; a key without one, or without a last value, has no bound.
    """
    bounded: Action = {}
    for key, value in target.items():
        per_s, before = speeds.get(key), last.get(key, value)
        bounded[key] = value if per_s is None else min(max(value, before - per_s * dt), before + per_s * dt)
    return bounded


logger = logging.getLogger(__name__)


class MockPolicy:
    """Policy that moves every joint along two slow sines around its middle.

    Motion is a function of the seed, the instruction, the start position and the count of steps, so a run can be
    repeated exactly. It starts at the present position with zero velocity and acceleration. A joint without a
    finite range does not move.

    Args:
        seed: any integer; another seed or another instruction is another motion.
        amplitude: used share of each half range, above 0 and at most 1.
        hz: control rate in which steps are counted; a slower loop makes a slower motion.
        fade_s: seconds in which the motion fades in from the start position.
    """

    uses_cameras = False
    follows_instruction = False

    def __init__(self, seed: int = 0, amplitude: float = 0.5, hz: float = 50.0, fade_s: float = 2.0) -> None:
        self._seed = whole("seed", seed)
        self._amplitude = number("amplitude", amplitude, above=0, high=1)
        self._dt = 1 / number("hz", hz, low=0.1, high=2000)
        self._fade_s = number("fade_s", fade_s, above=0, high=60)
        self._ranges: Ranges = {}
        self._waves: dict[str, tuple[float, float, float, float]] = {}
        self._start: dict[str, float] | None = None
        self._step = 0

    def reset(self, instruction: str, ranges: Ranges) -> None:
        self._ranges = {k: (low, high) for k, (low, high) in ranges.items() if math.isfinite(high - low)}
        if not self._ranges:
            raise ValidationError("the mock policy needs a robot with at least one action key of finite range.")
        unbounded = [key for key in ranges if key not in self._ranges]
        if unbounded:
            logger.info("The mock policy does not move %s, which have no range.", ", ".join(unbounded))
        digest = hashlib.blake2b(f"{self._seed}|{instruction}".encode(), digest_size=8).digest()
        draw = random.Random(int.from_bytes(digest)).uniform
        self._waves = {
            key: (draw(0.15, 0.3), draw(0, math.tau), draw(0.35, 0.6), draw(0, math.tau))
            for key in sorted(self._ranges)
        }
        self._start = None
        self._step = 0

    def act(self, observation: Mapping[str, Any]) -> Action:
        if self._start is None:
            present = numbers(observation)
            self._start = {key: min(max(present.get(key, (a + b) / 2), a), b) for key, (a, b) in self._ranges.items()}
        seconds = self._step * self._dt
        part = min(seconds / self._fade_s, 1.0)
        # The quintic from 0 to 1, smooth in velocity and acceleration.
        share = part * part * part * (part * (6 * part - 15) + 10)
        self._step += 1
        action: Action = {}
        for key, (low, high) in self._ranges.items():
            slow, slow_phase, fast, fast_phase = self._waves[key]
            swing = 0.7 * math.sin(math.tau * slow * seconds + slow_phase)
            swing += 0.3 * math.sin(math.tau * fast * seconds + fast_phase)
            wave = (low + high) / 2 + self._amplitude * (high - low) / 2 * swing
            action[key] = (1 - share) * self._start[key] + share * wave
        return action

    def interrupt(self) -> None:
        """Do nothing: this policy never waits."""

    def close(self) -> None:
        """Do nothing: this policy has no resources."""
