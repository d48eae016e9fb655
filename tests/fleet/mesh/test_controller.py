"""A safety controller on the mesh: stops at the same time, and the reports of other consoles."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from fixtures.mesh_robots import Arm
from tests.mesh.peers import Fleet, fleet

from strands_robots.fleet.mesh.stops import MeshController, MeshReports
from strands_robots.mesh import Mesh
from strands_robots.safety.orders import new_epoch


@pytest.fixture
def peers(tmp_path: Path) -> Iterator[Fleet]:
    with fleet(tmp_path) as joined:
        yield joined


def test_stop_keeps_the_robots_that_it_named_beside_another_stop(peers: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    mesh = peers.join(None, "safety-1")
    controller = MeshController(mesh)
    both = threading.Barrier(2)

    def sent(*_: Any, **__: Any) -> list[dict[str, Any]]:
        both.wait(20)
        return []

    monkeypatch.setattr(mesh, "emergency_stop", sent)
    with ThreadPoolExecutor(2) as pool:
        one, two = pool.submit(controller.stop, ["arm-1"]), pool.submit(controller.stop, ["arm-2"])
        assert (one.result(20).silent, two.result(20).silent) == (("arm-1",), ("arm-2",))


def test_stop_that_is_over_expects_no_further_robot(peers: Fleet) -> None:
    peers.join(Arm(), "arm-1")
    controller, epoch = MeshController(peers.join(None, "safety-1")), new_epoch()
    during: list[bool] = []
    report = controller.stop(
        ["arm-1"],
        estop_id=epoch,
        on_progress=lambda progress: during.append(controller.expect(epoch, ["arm-2"])),
    )
    assert during[0] is True
    assert "arm-2" in report.silent
    assert controller.expect(epoch, ["arm-3"]) is False


def test_reports_about_two_stops_of_one_peer_end_alone(peers: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    mesh: Mesh = peers.join(None, "console")
    listening: dict[str, Callable[..., None]] = {}
    monkeypatch.setattr(mesh, "listen", lambda topic, heard, name: listening.update({name: heard}))
    monkeypatch.setattr(mesh, "unsubscribe", listening.pop)
    one, two = MeshReports(mesh), MeshReports(mesh)
    one.begin()
    two.begin()
    assert len(listening) == 2
    one.close()
    assert len(listening) == 1
    two.close()
    assert listening == {}
