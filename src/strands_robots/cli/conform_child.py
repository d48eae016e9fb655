"""Process that makes a robot and checks it for ``conform``.

The first line of its input is the request. When the input ends, it halts the robot and ends itself. Its results are
JSON lines on the output; whatever the robot prints goes to the errors.
"""

from __future__ import annotations

import contextlib
import faulthandler
import json
import os
import shutil
import sys
import tempfile
import threading
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from typing import Any, TextIO

from strands_robots.adapted import behind_contract
from strands_robots.cli.conform import subject_of
from strands_robots.cli.output import Exit
from strands_robots.envelope import text_of
from strands_robots.errors import StrandsRobotsError
from strands_robots.testing import LongMotion, Subject, Tier, conform
from strands_robots.utils import ValidationError

HALTED_WITHIN_S = 4.0
"""Seconds in which a robot has to be halted at the end; then the process ends without it."""

Tell = Callable[..., None]


class Made:
    """The robot that the subject made last, and its halt."""

    def __init__(self, subject: Subject, tell: Tell) -> None:
        self.subject = replace(subject, make=self._make)
        self._inner, self._tell = subject.make, tell
        self._body: Any = None
        self._name = subject.name

    def _make(self) -> Any:
        body = self._inner()
        first, self._body = self._body is None, body
        if first:
            self._tell("made", robot=self._name or type(body).__name__)
        return body

    def halt(self) -> Mapping[str, Any]:
        """Halt it and return what it said."""
        if self._body is None:
            return {"stopped": True, "said": "It was not made yet."}
        verdict = behind_contract(self._body).halt("the check was ended")
        return {"stopped": verdict.stopped, "said": text_of(verdict.envelope())}


def main() -> int:
    """Check the robot of the request; return the exit code."""
    requests, tell = _streams()
    request = json.loads(requests.readline())
    faulthandler.enable()
    tempfile.tempdir = request["folder"]
    made: list[Made] = []
    threading.Thread(
        target=_end, args=(requests, request["folder"], made, tell), name="conform end", daemon=True
    ).start()
    try:
        tell("checking", check="bronze.made")
        made.append(Made(_subject(request), tell))
        report = conform(
            made[0].subject,
            Tier[request["tier"]],
            only=request["only"],
            report=lambda result: tell("result", **{**asdict(result), "tier": result.tier.name}),
            checking=lambda check: tell("checking", check=check),
            hardware=request["hardware"],
        )
    except (StrandsRobotsError, OSError) as exc:
        code = Exit.USAGE if isinstance(exc, ValidationError) else Exit.REFUSED
        tell("refused", reason=str(exc), exit=int(code))
        return int(code)
    tell("end", robot=report.name)
    return 0


def _subject(request: Mapping[str, Any]) -> Subject:
    subject = subject_of(request["target"], request["options"])
    motion = request["motion"]
    return subject if motion is None else replace(subject, motion=LongMotion(motion["verb"], motion["arguments"]))


def _streams() -> tuple[TextIO, Tell]:
    """Take input and output away from the robot: a driver may ask there, or print."""
    requests, results = os.fdopen(os.dup(0)), os.fdopen(os.dup(1), "w")
    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, 0)
    os.close(nothing)
    os.dup2(2, 1)
    lock = threading.Lock()

    def tell(event: str, **fields: Any) -> None:
        # A command that is gone reads no more.
        with lock, contextlib.suppress(BrokenPipeError):
            results.write(json.dumps({"event": event, **fields}, default=str) + "\n")
            results.flush()

    return requests, tell


def _end(requests: TextIO, folder: str, made: list[Made], tell: Tell) -> None:
    """Wait for the end of the input, then halt the robot and end the process."""
    requests.read()

    def halt() -> None:
        for each in made:
            try:
                tell("halted", **each.halt())
            except Exception as exc:  # noqa: BLE001 - the process ends in any case
                tell("halted", stopped=None, said=f"{type(exc).__name__}: {exc}")

    halting = threading.Thread(target=halt, name="conform halt", daemon=True)
    halting.start()
    halting.join(HALTED_WITHIN_S)
    # The command may have been killed, and not be there to remove it.
    shutil.rmtree(folder, ignore_errors=True)
    os._exit(int(Exit.INTERRUPTED))


if __name__ == "__main__":
    sys.exit(main())
