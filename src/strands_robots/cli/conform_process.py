"""A check in a process of its own, which a robot may hang, hold or crash."""

from __future__ import annotations

import contextlib
import json
import os
import queue
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from strands_robots.cli.output import CliError, Exit

if TYPE_CHECKING:
    from strands_robots.testing import CheckResult, ConformanceReport

PROGRAM = (sys.executable, "-m", "strands_robots.cli.conform_child")

ENDS_WITHIN_S = 6.0
"""Seconds in which the process has to end: it halts the robot first."""


@dataclass(frozen=True, slots=True)
class ConformRequest:
    """Robot and checks of one process.

    Attributes:
        target: as the command takes it.
        options: of a robot that is named.
        tier: the highest that is checked, in capitals.
        motion: the approved one of real hardware, ``verb`` and ``arguments``.
        limit_s: seconds that one check may take.
    """

    target: str
    options: Mapping[str, Any]
    tier: str
    only: tuple[str, ...] = ()
    hardware: bool = False
    motion: Mapping[str, Any] | None = None
    limit_s: float = 120.0

    def line(self, folder: str) -> str:
        """Return the line that the process reads first."""
        fields = {"target": self.target, "options": dict(self.options), "tier": self.tier, "only": self.only}
        return json.dumps({**fields, "hardware": self.hardware, "motion": self.motion, "folder": folder}) + "\n"


def conform_apart(request: ConformRequest, report: Callable[[CheckResult], None]) -> ConformanceReport:
    """Check a robot in a process of its own, and return the report.

    A process that dies, or takes longer than the limit for one check, fails that check. Ctrl-C halts the robot and ends
    the process. Nothing of it is left: no process, no port, no file.

    Args:
        request: what is checked.
        report: called with each result.

    Raises:
        CliError: the robot was refused, or the check was interrupted.
    """
    with tempfile.TemporaryDirectory(prefix="conform-", ignore_cleanup_errors=True) as folder:
        process = CheckProcess(request, folder, report)
        try:
            process.follow()
        except KeyboardInterrupt:
            said = process.end()
            raise CliError(f"Interrupted in {process.checking or 'no check'}. {said}", Exit.INTERRUPTED) from None
        finally:
            process.end()
        from strands_robots.testing import ConformanceReport  # noqa: PLC0415 - loaded beside the process, which loads it too

        return ConformanceReport(process.robot, tuple(process.results.values()), whole=not request.only)


class CheckProcess:
    """The process, and the results that it told.

    Attributes:
        robot: its name for the report.
        checking: the check under way, or "".
        results: by check.
    """

    def __init__(self, request: ConformRequest, folder: str, report: Callable[[CheckResult], None]) -> None:
        self.robot, self.checking, self._last = request.target, "", ""
        self.results: dict[str, CheckResult] = {}
        self._request, self._report = request, report
        self._lines: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        self._said, self._left = "It could not be halted.", False
        # A Ctrl-C at the terminal is the command's: it has the robot halted first.
        self._process = subprocess.Popen(
            PROGRAM, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True
        )
        threading.Thread(target=self._read, name="conform results", daemon=True).start()
        self._write(request.line(folder))

    def follow(self) -> None:
        """Take the results until the last one.

        Raises:
            CliError: the robot was refused.
        """
        while True:
            try:
                event = self._next(self._request.limit_s)
            except TimeoutError:
                halted = self.end()
                self._broken(f"{halted} No answer came for {self._request.limit_s:g} s, so the process was ended")
                return
            if event is None:
                self._broken(f"the process {self._ended()}")
                return
            match event.pop("event"):
                case "made":
                    self.robot = str(event["robot"])
                case "checking":
                    self.checking = str(event["check"])
                case "result":
                    self._last, self.checking = self.checking, ""
                    self._add(_result(event))
                case "refused":
                    raise CliError(event["reason"], Exit(event["exit"]))
                case "end":
                    self.robot = str(event["robot"])
                    self._finish()
                    return

    def end(self) -> str:
        """End the process, once it has halted the robot; return what is known of that."""
        if self._left:
            return self._said
        if self._process.poll() is None and self._process.stdin is not None:
            with contextlib.suppress(OSError):
                self._process.stdin.close()
            with contextlib.suppress(TimeoutError):
                until = time.monotonic() + ENDS_WITHIN_S
                while (event := self._next(max(0.0, until - time.monotonic()))) is not None:
                    if event["event"] == "halted":
                        self._said = f"Its halt said: {event['said']}"
        # With what the robot has started.
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        self._left = True
        return self._said

    def _finish(self) -> None:
        """Wait until the process has put the robot away."""
        try:
            self._process.wait(ENDS_WITHIN_S)
        except subprocess.TimeoutExpired:
            # A thread that the robot has left holds it; nothing is lost.
            return
        if self._process.returncode:
            self._broken(f"the process {self._ended()}")

    def _broken(self, problem: str) -> None:
        """Fail the check under way, and those that wait for it."""
        from strands_robots.testing import CheckMark, Tier, promises  # noqa: PLC0415 - as above

        only, known = self._request.only, {each.name: each for each in promises()}
        chosen = [each for each in promises(Tier[self._request.tier]) if not only or each.name in only]
        left = [each for each in chosen if each.name not in self.results]
        if self.checking:
            failed, where = known[self.checking], f"in {self.checking}"
        elif left:
            # Between two checks it is halted.
            halts = known["silver.halts"]
            failed, where = halts if halts in left else left[0], f"in the halt after {self._last}"
        else:
            failed, where = known["bronze.made"], "when it was put away"
        self._add(failed.result(CheckMark.FAILED, f"{problem} {where}."))
        for each in left:
            if each is not failed:
                lost = each.result(CheckMark.NOT_PROVEN, f"not checked: the process was lost in {failed.name}")
                self._add(replace(lost, waits_for=failed.name))

    def _add(self, result: CheckResult) -> None:
        self.results[result.check] = result
        self._report(result)

    def _ended(self) -> str:
        """Return how the process ended, in words."""
        try:
            code = self._process.wait(ENDS_WITHIN_S)
        except subprocess.TimeoutExpired:
            return "closed its results"
        return f"died of {signal.Signals(-code).name}" if code < 0 else f"ended itself with {code}"

    def _next(self, seconds: float) -> dict[str, Any] | None:
        """Return the next event; None at the end.

        Raises:
            TimeoutError: there is none in time.
        """
        try:
            line = self._lines.get(timeout=seconds)
        except queue.Empty:
            raise TimeoutError from None
        if line is None:
            self._lines.put(None)
            return None
        event: dict[str, Any] = json.loads(line)
        return event

    def _read(self) -> None:
        assert self._process.stdout is not None
        with self._process.stdout as lines:
            for line in lines:
                self._lines.put(line)
        self._lines.put(None)

    def _write(self, line: str) -> None:
        assert self._process.stdin is not None
        # A process that died at its start is reported by its end.
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.write(line)
            self._process.stdin.flush()


def _result(event: Mapping[str, Any]) -> CheckResult:
    from strands_robots.testing import CheckMark, CheckResult, Tier  # noqa: PLC0415 - as above

    return CheckResult(**{**event, "tier": Tier[event["tier"]], "mark": CheckMark(event["mark"])})
