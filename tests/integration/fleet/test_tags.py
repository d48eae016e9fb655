"""Tags on real networks: stated by a robot, found by ``where``, shown by ``peers``; a bare device has none."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from device_connect_edge.drivers import DeviceDriver
from fixtures.command_line import Machine
from fixtures.toy_robots import ToyRobot
from fixtures.waiting import eventually, free_port

from strands_robots import Robot, connect
from strands_robots.device_connect import init_device_connect_sync, loopback_config, stop_device_connect
from strands_robots.fleet.adapter import DEVICE_CONNECT, MESH
from strands_robots.mesh import init_mesh
from strands_robots.mesh.session import clear_peers
from strands_robots.utils import ValidationError


@pytest.fixture
def port(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    number = free_port()
    for name in ("STRANDS_DC_PORT", "STRANDS_MESH_PORT"):
        monkeypatch.setenv(name, str(number))
    yield number
    clear_peers()


def serve(stack: ExitStack, network: str, robot: Any, name: str, port: int, **stated: Any) -> None:
    """Serve a robot on one network until the stack ends."""
    if network == DEVICE_CONNECT:
        runtime = init_device_connect_sync(robot, peer_id=name, link=loopback_config(port), **stated)
        stack.callback(stop_device_connect, runtime)
    else:
        mesh = init_mesh(robot, name, "sim", **stated)
        assert mesh is not None
        stack.callback(mesh.close)


@pytest.mark.parametrize("network", [DEVICE_CONNECT, MESH])
def test_robots_are_found_by_all_of_their_tags(
    network: str, port: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    machine = Machine(tmp_path / "state", STRANDS_DC_PORT=str(port), STRANDS_MESH_PORT=str(port))
    (tmp_path / "state").mkdir(mode=0o700)
    flags = ("--mesh",) if network == MESH else ()
    with ExitStack() as stack:
        plain, mobile, shelf = (stack.enter_context(_closing(ToyRobot(name))) for name in ("a", "b", "c"))
        serve(stack, network, plain, "plain", port)
        fleet = stack.enter_context(connect())
        eventually(lambda: "plain" in fleet, what="the first robot")
        assert "tags" not in machine.run("peers", *flags).stdout
        mobile.tags = ("mobile", "lab-2")
        serve(stack, network, mobile, "mobile", port)
        monkeypatch.setenv("STRANDS_TAGS", "lab-2")
        serve(stack, network, shelf, "shelf", port)

        def found(*tags: str) -> list[str]:
            return [each.id for each in fleet.where(tags=tags)]

        eventually(lambda: found() == ["mobile", "plain", "shelf"], what="all robots")
        assert found("lab-2") == ["mobile", "shelf"]
        assert found("lab-2", "mobile") == ["mobile"]
        assert [each.id for each in fleet.where(tags="mobile", kind="toy")] == []
        assert {each.id: each.tags for each in fleet} == {
            "mobile": ("mobile", "lab-2"),
            "plain": (),
            "shelf": ("lab-2",),
        }
        with pytest.raises(ValidationError, match="tag"):
            fleet.where(tags="two words")
        shown = machine.run("peers", *flags).stdout
        assert "tags" in shown
        assert "mobile, lab-2" in shown
        listed = {each.get("id") or each["peer_id"]: each["tags"] for each in machine.json("peers", *flags)[1]["peers"]}
        # The fleet of this test is a peer of the mesh itself.
        robots = {name: tags for name, tags in listed.items() if not name.startswith("strands-robots-")}
        assert robots == {"mobile": ["mobile", "lab-2"], "plain": [], "shelf": ["lab-2"]}


def test_tags_that_are_given_win_on_both_networks_and_hold_for_a_world(
    port: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STRANDS_TAGS", "shell")
    with ExitStack() as stack:
        world = stack.enter_context(_closing(Robot("so100", mesh=True, peer_id="world", tags=("bench", "mobile"))))
        serve(stack, DEVICE_CONNECT, world, "other", port, tags="given")
        fleet = stack.enter_context(connect())
        eventually(lambda: {"other", "world"} <= {each.id for each in fleet}, what="both")
        assert fleet["other"].tags == ("given",)
        assert fleet["world"].tags == ("bench", "mobile")
        assert {each.tags for each in fleet["world"].robots.values()} == {("bench", "mobile")}


class Bare(DeviceDriver):  # type: ignore[misc]
    """A device that knows nothing of tags."""

    device_type = "bare"
    tags = "of another meaning"


def test_bare_device_has_none(port: int) -> None:
    with ExitStack() as stack:
        serve(stack, DEVICE_CONNECT, Bare(), "bare", port)
        fleet = stack.enter_context(connect(mesh=False))
        assert fleet["bare"].tags == ()
        assert fleet.where(tags="of") == []


@pytest.mark.parametrize("tags", ["two words", ["a"] * 3 + [f"t{i}" for i in range(17)]])
def test_robot_with_what_is_no_tag_is_not_served(port: int, tags: Any) -> None:
    with _closing(ToyRobot("toy")) as toy:
        with pytest.raises(ValidationError, match="tag"):
            init_device_connect_sync(toy, peer_id="arm-1", link=loopback_config(port), tags=tags)
        with pytest.raises(ValidationError, match="tag"):
            init_mesh(toy, "arm-1", tags=tags)
        with pytest.raises(ValidationError, match="tag"):
            Robot("so100", tags=tags)


class _closing:
    """A robot that is put away when the block ends."""

    def __init__(self, robot: Any) -> None:
        self._robot = robot

    def __enter__(self) -> Any:
        return self._robot

    def __exit__(self, *_: object) -> None:
        (getattr(self._robot, "close", None) or self._robot.cleanup)()
