"""The roster of an emergency stop: real processes that freeze and die, strangers, and a second machine."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest
from fixtures.command_line import COMMAND, Machine, on_a_terminal
from fixtures.nats_server import NatsServer
from fixtures.tcp_proxy import TcpProxy
from fixtures.waiting import eventually, free_port

from strands_robots.device_connect.backends import LinkConfig, loopback_config, open_client
from strands_robots.safety.sightings import Sightings
from strands_robots.safety.stop_link import notification

pytestmark = pytest.mark.timeout(600)


class Site(Machine):
    """A machine on one network."""

    def __init__(self, state: Path, link: LinkConfig | None, flags: tuple[str, ...], **more: str) -> None:
        super().__init__(state, **more)
        self.link, self.flags = link, flags

    def estop(self, *arguments: str) -> tuple[int, dict[str, Any]]:
        return self.json("estop", "--reason", "a test", *arguments, *self.flags)

    def remembers(self, *names: str) -> None:
        """Wait until this machine remembers these robots: a server writes them after its start."""
        store = Sightings(Path(self.environment["STRANDS_STATE_DIR"]))
        eventually(lambda: {*names} <= {each.name for each in store.read()[0]}, what=f"the memory of {names}")

    def elsewhere(self, state: Path) -> Site:
        """Another machine on the same network: it remembers nothing of this one."""
        return Site(state, self.link, self.flags, **{"STRANDS_DC_PORT": self.environment["STRANDS_DC_PORT"]})


@pytest.fixture(params=["zenoh", "nats", "mesh"])
def site(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Site]:
    with ExitStack() as stack:
        if request.param == "nats":
            url = stack.enter_context(NatsServer()).url
            yield Site(tmp_path / "state", LinkConfig(transport="nats", connect=(url,)), ("--nats", url))
        elif request.param == "mesh":
            port = str(free_port())
            yield Site(tmp_path / "state", None, ("--mesh",), STRANDS_MESH_PORT=port)
        else:
            made = Site(tmp_path / "state", None, ())
            made.link = loopback_config(int(made.environment["STRANDS_DC_PORT"]))
            yield made


@contextmanager
def frozen(process: Any) -> Iterator[None]:
    """Stop a process with SIGSTOP for the length of the block."""
    os.kill(process.pid, signal.SIGSTOP)
    try:
        yield
    finally:
        os.kill(process.pid, signal.SIGCONT)


def test_frozen_process_is_named_with_its_reason(site: Site) -> None:
    with site.serving("arm-1", *site.flags), site.serving("arm-2", *site.flags) as (second, _):
        site.remembers("arm-1", "arm-2")
        with frozen(second):
            code, said = site.estop()
            stopped, plainly = site.json("stop", "--all", *site.flags)
            freed, resumed = site.json("resume", "--local", "arm-1")
        for each, answer in ((code, said), (stopped, plainly)):
            assert each == 3, answer
            assert answer["reason"] == "NO ANSWER: arm-2."
            assert "SIGSTOP" in answer["reasons"]["arm-2"]
            assert answer["roster"]["size"] == 2
        assert said["silent"] == ["arm-2"]
        assert (freed, resumed["unheard"]) == (0, ["arm-2"]), resumed


def test_enrolled_robot_that_was_killed_is_named(site: Site) -> None:
    with site.serving("arm-1", *site.flags), site.serving("arm-2", *site.flags) as (second, _):
        assert site.json("enroll", *site.flags)[0] == 0
        code, said = site.estop()
        assert (code, said["roster"]) == (0, {"size": 2, "still": 2, "enrolled": 2}), said
        second.kill()
        second.wait()
        code, said = site.estop()
        assert code == 3, said
        assert said["silent"] == ["arm-2"]
        assert "its process on this machine has ended" in said["reasons"]["arm-2"]


@pytest.mark.parametrize("site", ["zenoh", "nats"], indirect=True)
def test_robot_that_answers_brings_those_known_under_another_address_of_its_network(site: Site) -> None:
    target = site.flags[1].rpartition(":")[2] if site.flags else site.environment["STRANDS_DC_PORT"]
    with TcpProxy(int(target)) as proxy, site.serving("arm-0", *site.flags):
        through = f"127.0.0.1:{proxy.port}"
        there = ("--nats", f"nats://{through}") if site.flags else ("--connect", f"tcp/{through}")
        with site.serving("arm-1", *there), site.serving("arm-2", *there) as (second, _):
            site.remembers("arm-0", "arm-1", "arm-2")
            code, said = site.estop("--deadline", "10")
            assert (code, said["stopped"].keys()) == (0, {"arm-0", "arm-1", "arm-2"}), said
            with frozen(second):
                code, said = site.estop()
            assert (code, said["silent"], said["elsewhere"]) == (3, ["arm-2"], 0), said
            assert "SIGSTOP" in said["reasons"]["arm-2"]


NAMES = 10_000


async def _flood(link: LinkConfig, over: threading.Event, begun: threading.Event) -> None:
    """Announce made-up devices, answer every stop in their names, and miss more of them."""
    messaging = await open_client(link)
    root = f"device-connect.{link.tenant}"
    stops: set[str] = set()

    async def heard(data: bytes, subject: str, reply: str | None) -> None:
        stops.add(str(json.loads(data)["params"].get("estop_id")))

    await messaging.subscribe_with_subject(f"{root}.*.event.emergencyStop", heard, subscribe_only=True)
    functions = {"functions": [{"name": "stop"}]}
    number, answered = 0, set[str]()
    while not over.is_set():
        for each in stops - answered:
            answered.add(each)
            missing = [{"name": f"ghost-{n}", "how": "enrolled"} for n in range(NAMES)]
            for few in (missing[:60], missing):
                report = notification("stopRoster", {"estop_id": each, "missing": few, "more": NAMES})
                await messaging.publish(f"{root}.stranger.event.stopRoster", report)
            for n in range(300):
                verdict = {"estop_id": each, "device_id": f"liar-{n}", "stopped": n % 2 == 0, "unknown": {}}
                answer = notification("emergencyStopVerdict", verdict)
                await messaging.publish(f"{root}.liar-{n}.event.emergencyStopVerdict", answer)
        for _ in range(200):
            name, number = f"made-up-{number % NAMES}", number + 1
            presence = json.dumps({"device_id": name, "capabilities": functions, "identity": {}, "status": {}})
            await messaging.publish(f"{root}.{name}.presence", presence.encode())
        if number >= NAMES:
            begun.set()
        await asyncio.sleep(0.01)
    await messaging.close()


@contextmanager
def strangers(link: LinkConfig) -> Iterator[None]:
    over, begun = threading.Event(), threading.Event()
    thread = threading.Thread(target=lambda: asyncio.run(_flood(link, over, begun)), daemon=True)
    thread.start()
    try:
        assert begun.wait(120)
        yield
    finally:
        over.set()
        thread.join(60)


@pytest.mark.parametrize("site", ["zenoh", "nats"], indirect=True)
def test_made_up_names_alter_no_exit_code_where_a_robot_is_enrolled(site: Site) -> None:
    assert site.link is not None
    with site.serving("arm-1", *site.flags) as (served, _):
        assert site.json("enroll", "arm-1", *site.flags)[0] == 0
        with strangers(site.link):
            code, said = site.estop("--deadline", "10")
            assert code == 0, said["reason"]
            assert set(said["stopped"]) == {"arm-1"}
            assert said["roster"]["size"] == 1
            assert said["others"]["count"] > 0
            served.kill()
            served.wait()
            code, said = site.estop("--deadline", "3")
            assert (code, said["silent"]) == (3, ["arm-1"]), said["reason"]


def test_standing_controller_names_a_robot_that_this_machine_never_heard(site: Site, tmp_path: Path) -> None:
    far = site.elsewhere(tmp_path / "far")
    if site.flags == ("--mesh",):
        far.environment["STRANDS_MESH_PORT"] = site.environment["STRANDS_MESH_PORT"]
    key = far.json("keys", "console")[1]["STRANDS_MESH_CONSOLE_PUBLIC_KEYS"]
    assert site.json("enroll", "--console", key)[0] == 0
    # The first one is where the others meet, so it is the one that goes on.
    with site.serving("arm-1", *site.flags), far.serving("arm-2", *site.flags) as (second, _):
        line = [*COMMAND, "safety-controller", "--id", "safety-2", *site.flags]
        with on_a_terminal(line, far.environment) as terminal:
            eventually(lambda: "arm-2" in terminal.drawn, what="the robot on the controller's screen")
            far.remembers("arm-2")
            with frozen(second):
                code, said = site.estop()
            assert (code, said["silent"]) == (3, ["arm-2"]), said
            assert "safety-2" in said["reasons"]["arm-2"] or "not answer" in said["reasons"]["arm-2"]


def test_broker_that_denies_the_stop_is_the_reason(tmp_path: Path) -> None:
    denying = """
authorization {
  users = [
    {user: robot, password: secret}
    {user: desk, password: secret, permissions: {publish: {deny: ["device-connect.*.desk-1.event.emergencyStop"]}}}
  ]
}
"""
    with NatsServer(accounts=denying) as server:
        where = server.url.removeprefix("nats://")
        machine = Machine(tmp_path / "state")
        with machine.serving("arm-1", "--nats", f"nats://robot:secret@{where}"):
            stop = ("estop", "--as", "desk-1", "--nats", f"nats://desk:secret@{where}", "--deadline", "2")
            code, said = machine.json(*stop)
        assert code == 3, said
        assert "permissions violation" in said["reasons"]["arm-1"].lower()
        records = machine.run("audit", "show", "--last", "600", "--json").stdout
        assert "permissions violation" in records.lower()
