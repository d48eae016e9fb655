"""What a policy is: it sees an observation and says which action comes next."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol, runtime_checkable

Action = dict[str, float]
"""Targets by action key, in the robot's own units."""

Ranges = Mapping[str, tuple[float, float]]
"""Lowest and highest target of every action key the body has; infinite where the body declares none."""


class PolicyError(RuntimeError):
    """A policy cannot go on, for a reason that its sentence tells in full: no traceback is needed."""


@runtime_checkable
class Policy(Protocol):
    """Decides a robot's actions. One object serves one rollout, on that rollout's control thread.

    ``uses_cameras`` is False for a policy that looks at numbers alone: it then works while a camera fails.
    """

    uses_cameras: bool

    def reset(self, instruction: str, ranges: Ranges) -> None:
        """Prepare for a task: load, connect, seed. Raises whatever makes the task impossible."""

    def act(self, observation: Mapping[str, Any]) -> Action | Sequence[Action] | None:
        """The next action, or a chunk of them played one a control step; None when the task is done.

        An empty chunk lets this control step pass without a command. Only the numbers of a robot's own action keys
        are accepted; the rollout ends with an error and a hold on anything else.
        """

    def interrupt(self) -> None:
        """The rollout is to end: a ``reset`` or ``act`` that waits shall give up. From another thread; never waits."""

    def close(self) -> None:
        """Free what the policy holds. Called once, whatever happened, also after a failed reset."""
