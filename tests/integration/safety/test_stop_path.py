"""The way of an emergency stop to the device of a real arm, hop by hop, is the one in docs/architecture.md."""

from __future__ import annotations

import itertools
from pathlib import Path

import pytest
from fixtures import mesh_call_path
from fixtures.call_path import Call, CallPath, documented, hops
from fixtures.devices import RecordingDevice
from fixtures.nats_server import NatsServer
from fixtures.planes import own_plane
from fixtures.waiting import eventually

from strands_robots.device_connect.backends import LinkConfig
from strands_robots.device_connect.stop_link import stop_link
from strands_robots.hardware import HardwareRobot
from strands_robots.safety import plane
from strands_robots.safety.estop_listener import EstopListener
from strands_robots.safety.orders import new_epoch
from strands_robots.safety.stop_link import ESTOP, notification

FUNCTIONS_MAX = 55
"""Functions of the package from the link's callback to the freeze, on every thread that the stop reaches."""

ARCHITECTURE = Path(__file__).parents[3] / "docs" / "architecture.md"


def way_of_a_stop() -> tuple[list[Call], list[str]]:
    """Stop an arm over NATS; the calls from the link's callback to the freeze, and all functions entered meanwhile."""
    device = RecordingDevice()
    with NatsServer() as server, CallPath() as path, own_plane(20.0) as here:
        config = LinkConfig(transport="nats", connect=(server.url,))
        robot = HardwareRobot(device, "arm")
        robot.connect()
        entry = here.register("arm", robot)
        listener = EstopListener(here)
        registration = listener.register("arm", config, lambda: stop_link(config))
        controller = stop_link(config)
        controller.open((), lambda event, source, payload: None, lambda up: None)
        try:
            eventually(lambda: registration.link.up and controller.up)
            robot.start_task("wave")
            eventually(lambda: device.writes)
            epoch = new_epoch()
            controller.publish("safety-1", ESTOP, notification(ESTOP, {"estop_id": epoch}))
            report = eventually(lambda: entry.reports.get(epoch))
            assert report.stopped is True
            assert device.writes[-1].action == device.positions, "the freeze"
            way = path.way_to("DeviceBody._hold")
        finally:
            controller.close()
            registration.close()
            robot.cleanup()
    callback = next(index for index, call in enumerate(way) if call.name.endswith("on_message"))
    return way[callback:], path.entered(way[callback:])


def test_stop_of_a_real_arm_takes_the_documented_way_with_two_hand_offs() -> None:
    way, _ = way_of_a_stop()
    threads = [name for name, _ in itertools.groupby(call.thread for call in way)]
    assert threads == ["stop-link", "estop-listener", "halt-arm"]
    assert hops(way) == documented(ARCHITECTURE, "stop-path")
    assert len(hops(way)) <= 13


@pytest.fixture
def slow_as_the_profiler(monkeypatch: pytest.MonkeyPatch) -> None:
    """A halt that is profiled takes many times as long, so that the reports of its stop wait for longer as well."""
    monkeypatch.setattr(plane, "YIELD_S", 0.01)


@pytest.mark.usefixtures("slow_as_the_profiler")
def test_stop_of_a_real_arm_enters_few_functions_before_the_freeze() -> None:
    fewest = min((way_of_a_stop()[1] for _ in range(4)), key=len)
    assert len(fewest) <= FUNCTIONS_MAX, "\n".join(fewest)


def test_stop_over_the_mesh_takes_the_documented_way_with_two_hand_offs(tmp_path: Path) -> None:
    way, _ = mesh_call_path.stop(tmp_path)
    assert len(list(itertools.groupby(call.thread for call in way))) == 3
    assert way[-1].thread == "halt-arm"
    assert hops(way) == documented(ARCHITECTURE, "mesh-stop-path")
    assert len(hops(way)) <= 13


@pytest.mark.usefixtures("slow_as_the_profiler")
def test_stop_over_the_mesh_enters_few_functions_before_the_freeze(tmp_path: Path) -> None:
    fewest = min((mesh_call_path.stop(tmp_path)[1] for _ in range(4)), key=len)
    assert len(fewest) <= FUNCTIONS_MAX, "\n".join(fewest)
