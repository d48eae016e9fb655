"""Mobile bases as devices: ``drive``, and ``navigateTo`` with a navigation stack."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

from strands_robots.device_connect._compat import Labels
from strands_robots.device_connect.robot_driver import RobotDeviceDriver
from strands_robots.serving.robot_verbs import BASE_VERBS, NAVIGATING_BASE_VERBS
from strands_robots.serving.verbs import Verb


class MobileBaseDeviceDriver(RobotDeviceDriver):
    """A mobile base. Start it with drive, end it with stop."""

    labels: ClassVar[Labels] = {"category": "mobile_base"}
    verbs: ClassVar[Mapping[str, Verb]] = BASE_VERBS


class NavigatingBaseDeviceDriver(MobileBaseDeviceDriver):
    """A mobile base that was made with a ``nav_action``. Start it with drive or navigateTo, end it with stop."""

    verbs: ClassVar[Mapping[str, Verb]] = NAVIGATING_BASE_VERBS
