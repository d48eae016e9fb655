"""Proof that a robot keeps its promises, and simulated robots for tests.

A robot is made on its emulated bus, served on both networks of this process, and checked tier by tier::

    from strands_robots.testing import BusRecorder, Subject, conform

    recorder = BusRecorder()
    report = conform(Subject(lambda: MyRobot(EmulatedBus(recorder)), recorder))
    print(report.words())

With pytest each check is a test of its own, and the fixture ``robots`` serves simulated robots::

    TestPromises = conformance_tests(Subject(...))

    def test_agent(robots):
        lab = robots(50)

Each name is imported on first use: pytest imports this package at its start.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from strands_robots.testing.conformance import conform, conform_live, promises
    from strands_robots.testing.promise_tests import conformance_tests
    from strands_robots.testing.report import CheckMark, CheckResult, ConformanceReport, Tier
    from strands_robots.testing.robot_lab import LabCall, LabRobot, RobotLab
    from strands_robots.testing.scripted_model import ScriptedModel
    from strands_robots.testing.subject import BusRecorder, BusWrite, LongMotion, Subject

__all__ = [
    "BusRecorder",
    "BusWrite",
    "CheckMark",
    "CheckResult",
    "ConformanceReport",
    "LabCall",
    "LabRobot",
    "LongMotion",
    "RobotLab",
    "ScriptedModel",
    "Subject",
    "Tier",
    "conform",
    "conform_live",
    "conformance_tests",
    "promises",
]

_HOMES = {
    "BusRecorder": "subject",
    "BusWrite": "subject",
    "CheckMark": "report",
    "CheckResult": "report",
    "ConformanceReport": "report",
    "LabCall": "robot_lab",
    "LabRobot": "robot_lab",
    "LongMotion": "subject",
    "RobotLab": "robot_lab",
    "ScriptedModel": "scripted_model",
    "Subject": "subject",
    "Tier": "report",
    "conform": "conformance",
    "conform_live": "conformance",
    "conformance_tests": "promise_tests",
    "promises": "conformance",
}
_EXTRAS = {"strands": "agent", "device_connect_edge": "device-connect", "zenoh": "mesh", "pydantic": "device-connect"}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    try:
        return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
    except ModuleNotFoundError as exc:
        extra = _EXTRAS.get((exc.name or "").partition(".")[0])
        if extra is None:
            raise
        raise import_module("strands_robots.utils").missing_extra(name, extra) from exc


def __dir__() -> list[str]:
    return sorted(__all__)
