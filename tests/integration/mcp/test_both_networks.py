"""One MCP server on both networks: each robot is called where it is, and a stop goes to all bearers of a name."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from itertools import count
from typing import Any

import pytest
from device_connect_edge.drivers import DeviceDriver, rpc
from fixtures.mcp_frames import RawServer
from fixtures.mcp_site import McpSite
from fixtures.mesh_peer import MeshPeer
from fixtures.toy_robots import ToyWorld
from fixtures.waiting import eventually, free_port

pytest.importorskip("mcp.server.mcpserver", reason="needs the extra mcp", exc_type=ImportError)

from strands_robots import Robot
from strands_robots.fleet.adapter import DEVICE_CONNECT, MESH
from strands_robots.safety.plane import plane

LONG = {"instruction": "wave", "duration": 60.0, "robot_name": "left", "wait": False}


class Twin(DeviceDriver):  # type: ignore[misc]
    """A device of another maker with a robot's id, and a stop."""

    device_type = "twin"

    def __init__(self) -> None:
        super().__init__()
        self.boiled, self.stopped = threading.Event(), threading.Event()

    @rpc()
    async def execute(self, instruction: str = "") -> dict[str, Any]:
        """Boil water."""
        self.boiled.set()
        return {"status": "success"}

    @rpc()
    async def stop(self) -> dict[str, Any]:
        """Stop boiling."""
        self.stopped.set()
        return {"status": "success", "stopped": True}


class Agent:
    """Client of a raw server, which remembers its frames' numbers."""

    def __init__(self, server: RawServer) -> None:
        self.server, self._numbers = server, count(1)

    def __call__(self, tool: str, **arguments: Any) -> Any:
        """Call a tool; return its structured content."""
        return self.ask("tools/call", name=tool, arguments=arguments)["structuredContent"]

    def ask(self, method: str, **params: Any) -> Any:
        """Ask for anything else; return the result."""
        return self.server.ask({"jsonrpc": "2.0", "id": next(self._numbers), "method": method, "params": params})[
            "result"
        ]

    @property
    def listed(self) -> list[str]:
        """The ids of all robots."""
        return [each["id"] for each in self("list_robots")["data"]["robots"]]


class Far:
    """Robots on the mesh, besides the site's on Device Connect: one on both, one whose id a foreign device has."""

    def __init__(self, site: McpSite) -> None:
        self.world, self.both, self.twin, self.device = ToyWorld("far"), ToyWorld("both"), ToyWorld("twin"), Twin()
        self.arm = Robot("so100", peer_id="arm-9", mesh=False)
        # Its thread lasts as long as the arm.
        self.arm.render(width=64, height=48)
        for name, body in {"far-1": self.world, "both-1": self.both, "twin-1": self.twin, "arm-9": self.arm}.items():
            site.serve(name, body, MESH)
        for name, device in {"both-1": self.both, "twin-1": self.device}.items():
            site.serve(name, device, DEVICE_CONNECT)

    def close(self) -> None:
        """End the robots."""
        for each in (self.world, self.both, self.twin):
            each.close()
        self.arm.cleanup()


@pytest.fixture(scope="module")
def far(site: McpSite) -> Iterator[Far]:
    robots = Far(site)
    yield robots
    robots.close()


@pytest.fixture(scope="module")
def agent(site: McpSite, far: Far) -> Iterator[Agent]:
    with RawServer(site) as server:
        yield Agent(server)


def moving(world: ToyWorld) -> bool:
    return any(each.running for each in world.rollouts.values())


def test_robots_of_both_are_listed_once_each(agent: Agent) -> None:
    everyone = {"arm-1", "arm-2", "metal-1", "far-1", "both-1", "twin-1", "arm-9"}
    eventually(lambda: set(agent.listed) == everyone, 30.0, what="all robots")
    assert len(agent.listed) == len(everyone)
    uris = [each["uri"] for each in agent.ask("resources/list")["resources"]]
    assert sorted(uris) == sorted(f"robot://{name}" for name in everyone)


def test_arm_of_the_mesh_is_read_and_moved_by_every_tool(agent: Agent) -> None:
    described = agent("describe_robot", robot="arm-9")["data"]
    assert {"moveTo", "getPose", "start"} <= {each["name"] for each in described["verbs"]}
    assert agent("get_state", robot="arm-9")["data"]["state"]
    pose = agent("get_pose", robot="arm-9")
    assert pose["data"]["joints"], pose
    assert agent("get_objects", robot="arm-9")["status"] == "success"
    picture = agent.server.ask(
        agent.server.call("picture", "get_picture", {"robot": "arm-9", "width": 64, "height": 48})
    )
    assert {each["type"] for each in picture["result"]["content"]} == {"text", "image"}
    assert agent("acquire_control", robot="arm-9")["status"] == "success"
    begun = agent("grasp", robot="arm-9", action="set_gripper", opening=1.0, wait=False)
    assert begun["status"] == "success", begun
    ended = agent("wait_for", robot="arm-9", task_id=begun["data"]["task_id"], seconds=9.0)
    assert ended["data"]["verb"] == "setGripper"
    assert agent("release_control", robot="arm-9")["status"] == "success"
    assert agent("call_robot", robot="arm-9", verb="savePlace", arguments={"place": "here"})["status"] == "success"
    read = agent.ask("resources/read", uri="robot://arm-9")["contents"][0]["text"]
    assert '"robot": "arm-9"' in read


def test_motion_of_a_robot_on_both_goes_to_it_once(agent: Agent, far: Far) -> None:
    assert agent("acquire_control", robot="both-1", robot_name="left")["status"] == "success"
    begun = agent("run_policy", robot="both-1", **LONG)
    assert begun["status"] == "success", begun
    eventually(lambda: moving(far.both))
    assert len(far.both.answers) == 1
    assert agent("stop", robot="both-1")["status"] == "success"
    assert not moving(far.both)
    assert agent("release_control", robot="both-1", robot_name="left")["status"] == "success"


def test_motion_is_refused_where_no_key_decides_and_a_stop_goes_to_both(agent: Agent, far: Far) -> None:
    far.twin.start_policy("left", "wave", duration=60.0)
    eventually(lambda: moving(far.twin))
    refused = agent("run_policy", robot="twin-1", instruction="wave")
    assert "device_connect and mesh both have a robot of this id" in refused["text"]
    acquired = agent("acquire_control", robot="twin-1")
    assert "device_connect and mesh both have a robot of this id" in acquired["text"]
    assert not far.device.boiled.is_set()
    agent("stop", robot="twin-1")
    assert far.device.stopped.is_set()
    assert not moving(far.twin)


def test_stop_of_all_reaches_both_networks(agent: Agent, site: McpSite, far: Far) -> None:
    for world in (site.world, far.world):
        world.start_policy("left", "wave", duration=60.0)
        eventually(lambda world=world: moving(world))
    stopped = agent("stop")
    assert not moving(site.world)
    assert not moving(far.world)
    assert {"arm-1", "far-1"} <= set(stopped["data"]["robots"])


def test_emergency_stop_locks_both_networks_and_lockouts_names_them(agent: Agent, site: McpSite, far: Far) -> None:
    for world in (site.world, far.world):
        world.start_policy("left", "wave", duration=60.0)
        eventually(lambda world=world: moving(world))
    try:
        answer = agent("emergency_stop", reason="a test")
        assert not moving(site.world)
        assert not moving(far.world)
        assert answer["data"]["estop_id"]
        rows = agent("lockouts")["data"]["robots"]
        assert all(rows[name]["lockouts"][0]["epoch"] == answer["data"]["estop_id"] for name in ("arm-1", "far-1"))
        for robot in ("arm-1", "far-1"):
            refused = agent("run_policy", robot=robot, instruction="wave", robot_name="left")
            assert refused["status"] == "error", refused
            assert "lock" in refused["text"] or "rejected" in refused["text"]
    finally:
        plane().clear_local("the test")


def test_server_stands_on_both_networks(agent: Agent) -> None:
    eventually(lambda: agent("lockouts")["data"]["stands"], 60.0, what="its e-stop links")


def test_robot_of_no_network_is_refused_with_similar_names(agent: Agent) -> None:
    refused = agent("get_pose", robot="arm-8")
    assert "No robot 'arm-8' is in reach" in refused["text"]
    assert "list_robots names those that there are." in refused["text"]


def test_server_of_the_mesh_alone_has_no_device(site: McpSite, far: Far, monkeypatch: pytest.MonkeyPatch) -> None:
    # Its port is then the mesh's.
    monkeypatch.setattr(site, "port", int(site.environment["STRANDS_MESH_PORT"]))
    with RawServer(site, "--mesh") as server:
        agent = Agent(server)
        eventually(lambda: "far-1" in agent.listed, 30.0, what="the robots of the mesh")
        assert "arm-1" not in agent.listed


def test_mesh_that_comes_later_is_joined(site: McpSite, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = {"STRANDS_MESH_PORT": str(free_port())}
    monkeypatch.setitem(site.environment, *settings.popitem())
    with RawServer(site) as server:
        agent = Agent(server)
        assert "arm-1" in agent.listed
        with MeshPeer("late-1", "world", {"STRANDS_MESH_PORT": site.environment["STRANDS_MESH_PORT"]}) as peer:
            eventually(lambda: "late-1" in agent.listed, 60.0, what="the robot of the mesh")
            assert agent("acquire_control", robot="late-1")["status"] == "success"
            begun = agent("run_policy", robot="late-1", instruction="wave", wait=False)
            assert begun["status"] == "success", begun
            assert agent("stop", robot="late-1")["status"] == "success"
            eventually(lambda: agent("lockouts")["data"]["stands"], 60.0, what="its stand on the mesh")
            assert peer.peer_id in agent("lockouts")["data"]["robots"]
