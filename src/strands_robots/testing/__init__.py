"""Proof that a robot keeps its promises, for the robots of others and for ours.

A robot is made on its emulated bus, served on both networks of this process, and checked tier by tier::

    from strands_robots.testing import BusRecorder, Subject, conform

    recorder = BusRecorder()
    report = conform(Subject(lambda: MyRobot(EmulatedBus(recorder)), recorder))
    print(report.words())
"""

from __future__ import annotations

from strands_robots.testing.conformance import conform, conform_live, promises
from strands_robots.testing.report import CheckMark, CheckResult, ConformanceReport, Tier
from strands_robots.testing.subject import BusRecorder, BusWrite, LongMotion, Subject

__all__ = [
    "BusRecorder",
    "BusWrite",
    "CheckMark",
    "CheckResult",
    "ConformanceReport",
    "LongMotion",
    "Subject",
    "Tier",
    "conform",
    "conform_live",
    "promises",
]
