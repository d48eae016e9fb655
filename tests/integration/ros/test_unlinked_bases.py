"""Stops of bases that nobody was ever linked to: none is called stopped, and each stop begins at once."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager

import pytest
from fixtures.reachy_daemon.broken import BrokenDaemon
from fixtures.waiting import free_port

from strands_robots.drivers.ros.mobile_base import MobileBaseRobot
from strands_robots.drivers.ros.ros_bridge import RosBridgedRobot
from strands_robots.drivers.ros.rosbridge_robot import RosbridgeRobot
from strands_robots.drivers.ros.rtps_robot import RtpsRobot
from strands_robots.safety.stop_executor import stop_executor

pytestmark = pytest.mark.timeout(120)

LONELY_DOMAIN = 87


@contextmanager
def refused() -> Iterator[MobileBaseRobot]:
    yield RosbridgeRobot("base", "/cmd_vel", "/odom", host="127.0.0.1", port=free_port())


@contextmanager
def hung() -> Iterator[MobileBaseRobot]:
    with BrokenDaemon("hangs") as server:
        yield RosbridgeRobot("base", "/cmd_vel", "/odom", host="127.0.0.1", port=server.port)


@contextmanager
def alone_on_dds() -> Iterator[MobileBaseRobot]:
    yield RtpsRobot("base", "/cmd_vel", domain_id=LONELY_DOMAIN)


@contextmanager
def alone_on_ros() -> Iterator[MobileBaseRobot]:
    yield RosBridgedRobot("base", "/cmd_vel", "/odom", domain_id=LONELY_DOMAIN)


BASES = [refused, hung, alone_on_dds, alone_on_ros]


@pytest.mark.parametrize("make", BASES, ids=lambda make: make.__name__)
def test_a_base_that_was_never_linked_is_not_called_stopped(
    make: Callable[[], AbstractContextManager[MobileBaseRobot]],
) -> None:
    with make() as base:
        try:
            for _ in range(3):
                began = time.monotonic()
                assert stop_executor().halt(base, "base", "test").stopped is not True
                assert time.monotonic() - began < 10, "the deadline is 1 s"
        finally:
            base.disconnect()
