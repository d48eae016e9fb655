"""The policy protocol, and the check of actions of policies and leaders."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Protocol, runtime_checkable

from strands_robots.errors import StrandsRobotsError
from strands_robots.utils import ValidationError, mapping, number, shown

Action = dict[str, float]
"""Targets by action key, in the robot's own units."""

Ranges = Mapping[str, tuple[float, float]]
"""Lowest and highest target of every action key of a body; infinite where the body declares none."""


class PolicyError(StrandsRobotsError, RuntimeError):
    """A policy cannot go on; the message is logged without a traceback."""


@runtime_checkable
class Policy(Protocol):
    """Source of a robot's actions; one object serves one rollout, on its thread.

    ``uses_cameras`` is False for a policy that looks at numbers alone: it then works while a camera fails. A policy
    that does not do what the instruction says has ``follows_instruction = False`` besides.
    """

    uses_cameras: bool

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


def follows_instruction(policy: Policy) -> bool:
    """Return False for a policy that moves by itself, whatever it was told."""
    return getattr(policy, "follows_instruction", True) is not False


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
        checked[key] = min(max(number(f"action[{key!r}]", _plain(value)), low), high)
    return checked


def numbers(observation: Mapping[str, object]) -> dict[str, float]:
    """Return the finite numbers of an observation, without images, flags and text."""
    finite: dict[str, float] = {}
    for key, value in observation.items():
        scalar = _plain(value)
        if isinstance(scalar, int | float) and not isinstance(scalar, bool) and math.isfinite(scalar):
            finite[key] = float(scalar)
    return finite


def _plain(value: object) -> object:
    """Unwrap a scalar of an array package; return anything else unchanged."""
    item = getattr(value, "item", None)
    return item() if callable(item) and getattr(value, "ndim", None) == 0 else value


class SpeedLimit:
    """Bound on how fast each target may change, in units a second of its key.

    Args:
        ranges: a key with a finite range may cross it ``full_ranges_per_s`` times a second.
        full_ranges_per_s: above 0.
        unbounded_per_s: bound of a key without a range, in its unit a second.
    """

    def __init__(self, ranges: Ranges, full_ranges_per_s: float, unbounded_per_s: float) -> None:
        self._per_s = {
            key: (high - low) * full_ranges_per_s if math.isfinite(high - low) else unbounded_per_s
            for key, (low, high) in ranges.items()
        }

    def limit(self, target: Action, last: Mapping[str, float], dt: float) -> Action:
        """Return ``target``, moved no further from ``last`` than ``dt`` seconds allow.

        A key without a last value is not limited.
        """
        limited: Action = {}
        for key, value in target.items():
            reach = self._per_s[key] * dt
            before = last.get(key, value)
            limited[key] = min(max(value, before - reach), before + reach)
        return limited
