"""One name, one robot in the safety plane of a process, whatever number of networks it is on."""

from __future__ import annotations

from pathlib import Path

import pytest
from fixtures.mesh_robots import Arm

from strands_robots.mesh.door import PlaneDoor
from strands_robots.safety.orders import StopOrder, new_epoch
from strands_robots.safety.persistence import LockoutStore
from strands_robots.safety.plane import SafetyPlane
from strands_robots.utils import ValidationError


def test_another_robot_under_a_name_that_is_taken_is_refused(tmp_path: Path) -> None:
    plane = SafetyPlane(LockoutStore(tmp_path))
    door = PlaneDoor("arm-1", Arm("one"), None, plane)
    with pytest.raises(ValidationError, match="arm-1"):
        PlaneDoor("arm-1", Arm("another"), None, plane)
    door.close()
    PlaneDoor("arm-1", Arm("another"), None, plane).close()


def test_the_same_robot_on_a_second_network_shares_its_lockout(tmp_path: Path) -> None:
    plane = SafetyPlane(LockoutStore(tmp_path))
    arm = Arm("one")
    first = plane.register("arm-1", arm)
    door = PlaneDoor("arm-1", arm, None, plane)
    order = StopOrder(new_epoch(), "console", "test", "mesh")
    verdict = door.begin(order)
    assert verdict is not None
    assert verdict() is not None
    assert door.epochs() == first.epochs == (order.epoch,)
    assert len(arm.halts) == 1
    door.close()
    first.close()
