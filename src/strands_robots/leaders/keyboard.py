"""A keyboard as a leader: a pair of keys for each joint."""

from __future__ import annotations

import os
import select
import sys
import termios
import tty
from collections.abc import Mapping
from types import TracebackType
from typing import Self

from strands_robots.leaders.jog import Jog
from strands_robots.policies.base import Action, Ranges
from strands_robots.teleop import LeaderDone
from strands_robots.utils import ValidationError

UP, DOWN = "qwertyuiop", "asdfghjkl;"
"""The key of each joint, in their order, that raises and lowers it."""

STEP_S = 0.1
"""One press moves a joint as far as a held one goes in so long."""

_END = "\x1b\x03\x04"


class KeyboardLeader:
    """Reads single keys of a terminal while it is entered as a context; Escape or Ctrl-D ends the leading.

    Args:
        start: where the follower stands, by action key; at most ten joints.
        ranges: of the follower's action keys.
        fd: the terminal; standard input by default.

    Raises:
        ValidationError: too many joints, or ``fd`` is no terminal.
    """

    def __init__(self, start: Mapping[str, float], ranges: Ranges, fd: int | None = None) -> None:
        if len(start) > len(UP):
            raise ValidationError(f"start must hold at most {len(UP)} joints, not {len(start)}.")
        self._fd = sys.stdin.fileno() if fd is None else fd
        if not os.isatty(self._fd):
            raise ValidationError("keyboard needs a terminal; standard input is none.")
        self._jog = Jog(start, ranges)
        self._pushes = {up: (key, 1.0) for up, key in zip(UP, self._jog.keys, strict=False)}
        self._pushes |= {down: (key, -1.0) for down, key in zip(DOWN, self._jog.keys, strict=False)}
        self._before: list[int | list[bytes | int]] | None = None

    @property
    def is_connected(self) -> bool:
        """Whether the terminal gives single keys."""
        return self._before is not None

    @property
    def help(self) -> list[tuple[str, str, str]]:
        """For each joint: its name, the key that raises it and the one that lowers it."""
        return [(key, UP[index], DOWN[index]) for index, key in enumerate(self._jog.keys)]

    def __enter__(self) -> Self:
        self._before = termios.tcgetattr(self._fd)
        tty.setcbreak(self._fd)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, exc: BaseException | None, trace: TracebackType | None
    ) -> None:
        before, self._before = self._before, None
        if before is not None:
            termios.tcsetattr(self._fd, termios.TCSADRAIN, before)

    def get_action(self) -> Action:
        """Every target, after the keys that were pressed since.

        Raises:
            LeaderDone: Escape or Ctrl-D was pressed.
        """
        while select.select([self._fd], [], [], 0)[0]:
            pressed = os.read(self._fd, 64).decode("ascii", "ignore")
            if not pressed:
                break
            for char in pressed:
                if char in _END:
                    raise LeaderDone("the keyboard ended it")
                if char.lower() in self._pushes:
                    key, push = self._pushes[char.lower()]
                    self._jog.move(key, push, STEP_S)
        return self._jog.targets
