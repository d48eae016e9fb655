"""Selection of motors, and the imports of the driver."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import pytest

from strands_robots.drivers.reachy.driver import motor_names
from strands_robots.utils import ValidationError


@pytest.mark.parametrize(
    ("motor_ids", "names"),
    [("", ()), ("17", ("right_antenna",)), ("stewart_1, 11 ,10", ("stewart_1", "body_rotation"))],
)
def test_motors_are_selected_by_name_or_bus_id(motor_ids: str, names: tuple[str, ...]) -> None:
    assert motor_names(motor_ids) == names


@pytest.mark.parametrize("motor_ids", [",", " ", "19", "head", 17, None, "17;18"])
def test_list_without_a_motor_is_refused(motor_ids: Any) -> None:
    with pytest.raises(ValidationError, match="motor_ids"):
        motor_names(motor_ids)


def test_both_transport_modules_are_the_same_and_load_with_the_standard_library_alone() -> None:
    code = (
        "import sys; before = set(sys.modules)\n"
        "from strands_robots.drivers import reachy_transport as one\n"
        "from strands_robots.device_connect import reachy_transport as two\n"
        "from strands_robots.drivers.reachy import ReachyDriver\n"
        "assert one.api is two.api and one.WebSocketLink is two.WebSocketLink and one.ZenohLink is two.ZenohLink\n"
        "ReachyDriver('localhost')\n"
        "new = {name.partition('.')[0] for name in set(sys.modules) - before}\n"
        "foreign = sorted(new - set(sys.stdlib_module_names) - {'strands_robots'})\n"
        "assert not foreign, foreign\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=100)
