"""Selection of motors, and the imports of the driver."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import pytest

from strands_robots.drivers.reachy import make_reachy
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


@pytest.mark.parametrize(
    ("stated", "port", "dialled"),
    [
        ("head.local", "", ("head.local", 8000)),
        ("head.local", "8001", ("head.local", 8001)),
        ("head.local:8002", "8001", ("head.local", 8002)),
        ("192.168.1.7:8003", "", ("192.168.1.7", 8003)),
        ("::1", "8004", ("::1", 8004)),
        ("[::1]:8005", "", ("[::1]", 8005)),
    ],
)
def test_robot_that_no_argument_names_is_that_of_the_environment(
    monkeypatch: pytest.MonkeyPatch, stated: str, port: str, dialled: tuple[str, int]
) -> None:
    monkeypatch.setenv("REACHY_HOST", stated)
    monkeypatch.setenv("REACHY_PORT", port)
    connection = make_reachy().connection
    assert (connection.host, connection.port) == dialled
    assert make_reachy("other.local", api_port=9000).connection.port == 9000


@pytest.mark.parametrize("stated", ["http://head.local", "head.local:0", "head.local:99999", "a b"])
def test_invalid_robot_of_the_environment_is_refused(monkeypatch: pytest.MonkeyPatch, stated: str) -> None:
    monkeypatch.setenv("REACHY_HOST", stated)
    with pytest.raises(ValidationError):
        make_reachy()


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
