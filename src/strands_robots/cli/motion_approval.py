"""Approval of the motions that a check makes."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from strands_robots.cli.app import assignments
from strands_robots.cli.output import CliError, Screen
from strands_robots.safety.authorization import digest
from strands_robots.utils import ValidationError, shown

if TYPE_CHECKING:
    from strands_robots.testing import LongMotion

FLAG = "--approve-motions"

LET_GO = "It is let go at the end: without power an arm sinks."


@dataclass(frozen=True, slots=True)
class MotionList:
    """Motions that a check makes, a sentence each.

    ``digest`` names this list: another motion, or another robot, has another one.
    """

    robot: str
    lines: Sequence[str]

    @property
    def digest(self) -> str:
        """Twelve hex digits of the list's SHA-256."""
        return digest({"robot": self.robot, "motions": list(self.lines)})[:12]

    def approve(self, screen: Screen, given: str | None) -> None:
        """Print the list; return once its operator has approved it.

        Args:
            screen: where it is printed, and asked at a terminal.
            given: the digest that came with the command.

        Raises:
            ValidationError: the digest is that of another list.
            CliError: no one approved it; nothing has moved.
        """
        screen.data({"event": "motions", "robot": self.robot, "motions": list(self.lines), "digest": self.digest})
        screen.say(f"These checks move {self.robot}:", "bold")
        for line in self.lines:
            screen.copyable(f"  {line}")
        if given is not None:
            if given != self.digest:
                raise ValidationError(f"{FLAG} must be {self.digest}, which names this list, not {shown(given)}.")
            return
        if not (screen.live and sys.stdin.isatty()):
            raise CliError(f"Nothing was moved. Whoever stands beside {self.robot} approves it: {FLAG} {self.digest}")
        if not _yes("Can it move so now, and do you stand beside it? [y/N] "):
            raise CliError("Nothing was moved: the motions were not approved.")


def parse_motion(text: str) -> LongMotion:
    """Return the motion of ``VERB KEY=VALUE ...``; a value is JSON where possible.

    Raises:
        ValidationError: it is none.
    """
    from strands_robots.testing import LongMotion  # noqa: PLC0415 - loads both networks

    try:
        words = shlex.split(text)
    except ValueError as exc:
        raise ValidationError(f"--motion must be VERB KEY=VALUE ..., not {shown(text)}: {exc}.") from None
    if not words or not words[0].isidentifier():
        raise ValidationError(f"--motion must be VERB KEY=VALUE ..., not {shown(text)}.")
    return LongMotion(words[0], assignments(words[1:]))


def lines_of(motion: LongMotion, starts: int, wrong: bool) -> list[str]:
    """Return the sentences of one motion.

    Args:
        motion: with its arguments.
        starts: how often it is started, at most.
        wrong: it is called with wrong arguments as well.
    """
    called = f"{motion.verb}({_named(motion.arguments)})"
    lines = []
    if starts:
        often = "once" if starts == 1 else f"up to {starts} times"
        lines.append(f"{called}, {often}: each is stopped when it runs, or after 10 s. If a stop fails, it goes on.")
    if wrong:
        lines.append(f"{motion.verb} with one argument wrong, which it has to refuse. A robot that takes it moves.")
    return lines


def connected(options: Mapping[str, Any]) -> str:
    """Return the sentence of a robot that is made with these options."""
    made = f" with {_named(options)}" if options else ""
    return f"It is made{made} and connected, which powers its motors and may move it."


def _named(arguments: Mapping[str, Any]) -> str:
    return ", ".join(f"{name}={value!r}" for name, value in arguments.items())


def _yes(question: str) -> bool:
    try:
        return input(question).strip().lower() in ("y", "yes")
    except EOFError:
        return False
