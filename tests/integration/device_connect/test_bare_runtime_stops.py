"""Our driver in the framework's own runtime, on its own backends: an emergency stop halts it and locks it."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from fixtures.bare_caller import Caller
from fixtures.bare_robot import bare_robot
from fixtures.child import Child
from fixtures.nats_server import NatsServer
from fixtures.stop_controller import controller
from fixtures.waiting import free_port, until
from fixtures.zenoh_router import ZenohRouter

from strands_robots.device_connect.backends import LinkConfig, open_client
from strands_robots.mesh.resume_authority import keygen
from strands_robots.safety.ed25519 import load_signing_key
from strands_robots.safety.resume import sign

PASSPHRASE = "Correct-Horse-7-Battery"


@dataclass(frozen=True)
class Site:
    """A network, our link to it, and a way to start the robot ``arm-1`` there."""

    link: LinkConfig
    serve: Callable[..., Child]

    @contextmanager
    def robot(self, **environment: str) -> Iterator[Child]:
        with self.serve(**environment) as child:
            yield child


@pytest.fixture(params=["zenoh d2d", "zenoh router", "nats"])
def site(request: pytest.FixtureRequest) -> Iterator[Site]:
    if request.param == "zenoh d2d":
        endpoint = f"tcp/127.0.0.1:{free_port()}"
        link = LinkConfig(mode="peer", connect=(endpoint,), multicast=False)
        yield Site(link, lambda **more: bare_robot("arm-1", "zenoh", ZENOH_LISTEN=endpoint, **more))
        return
    transport = request.param.split()[0]
    with NatsServer() if transport == "nats" else ZenohRouter() as broker:
        url = broker.url if transport == "nats" else broker.endpoint
        link = LinkConfig(transport, connect=(url,))
        yield Site(link, lambda **more: bare_robot("arm-1", transport, url, **more))


async def emit_stop(client: Any, estop_id: str, source: str = "safety-1") -> None:
    """Send an emergency stop as the framework's own event."""
    event = {"jsonrpc": "2.0", "method": "emergencyStop", "params": {"reason": "test", "estop_id": estop_id}}
    await client.publish(f"device-connect.default.{source}.event.emergencyStop", json.dumps(event).encode())


async def stop(site: Site, robot: Child, estop_id: str = "ab" * 16) -> None:
    """Stop the moving robot and wait until it stands and is locked."""
    assert robot.ask("start") == "success"
    async with Caller(client=await open_client(site.link)) as caller:
        await caller.sees("arm-1")
        await emit_stop(caller.client, estop_id)
        await until(lambda: not robot.ask("moving"), what="it stands")
        await until(lambda: robot.ask("locked"), what="it is locked")


async def test_emergency_stop_locks_until_the_signed_resume(site: Site, tmp_path: Path) -> None:
    file = str(tmp_path / "operator.pem")
    with site.robot(STRANDS_MESH_RESUME_PUBLIC_KEY=keygen(file, PASSPHRASE)) as robot:
        await stop(site, robot)
        async with Caller(client=await open_client(site.link)) as caller:
            refused = (await caller.call("arm-1", "execute", {"instruction": "wave", "source_device": "x"}))["result"]
            assert (refused["status"], refused["locked"], refused["stopped_by"]) == ("error", True, "safety-1")
            told = (await caller.call("arm-1", "getStatus"))["result"]
            assert (told["locked"], told["lockout"][0]["epoch"]) == (True, "ab" * 16)
            (assertion,) = sign(load_signing_key(file, PASSPHRASE), "ab" * 16, ["arm-1"])
            resumed = (await caller.call("arm-1", "resume", {"assertion": assertion}))["result"]
            assert resumed["status"] == "success"
        assert robot.ask("locked") is False
        assert robot.ask("start") == "success"


async def test_controller_gets_the_signed_verdict_of_a_bare_robot_by_name(site: Site) -> None:
    with site.robot() as robot, controller(site.link) as safety:
        assert robot.ask("start") == "success"
        assert robot.ask("link_up") and safety.ask("up")
        report = safety.ask("stop", ["arm-1"], 20.0)
        assert report["ok"] is True, report
        assert robot.ask("moving") is False
        assert robot.ask("locked") is True


async def test_lockout_outlives_runtime_driver_and_process(site: Site) -> None:
    with ExitStack() as first:
        robot = first.enter_context(site.robot())
        await stop(site, robot)
        robot.ask("leave")
        assert robot.ask("planned") == []
        assert robot.ask("locked") is True, "a driver off the network is locked as it was"
        robot.ask("enter")
        assert robot.ask("planned") == ["arm-1"]
        assert robot.ask("locked") is True
        robot.kill()
    with site.robot() as again:
        assert again.ask("locked") is True
        assert again.ask("clear") == ["arm-1"]
        assert again.ask("start") == "success"


async def test_driver_served_by_ours_afterwards_is_registered_once_and_stays_locked(site: Site) -> None:
    with site.robot() as robot:
        await stop(site, robot)
        robot.ask("leave")
        assert robot.ask("serve_ours") is True
        assert robot.ask("planned") == []
        robot.ask("enter")
        assert robot.ask("planned") == ["arm-1"]
        assert robot.ask("clear") == ["arm-1"]
        await stop(site, robot, "cd" * 16)


@pytest.mark.parametrize("setting", ["DEVICE_CONNECT_ESTOP_ALLOW", "STRANDS_ESTOP_REQUIRE_SIGNED"])
async def test_stop_that_does_not_count_neither_halts_nor_locks(site: Site, setting: str) -> None:
    if setting != "DEVICE_CONNECT_ESTOP_ALLOW":
        with pytest.raises(RuntimeError, match="ended"):
            # Only signed stops count and no key could have signed one: it does not start, as with our own runtime.
            site.serve(**{setting: "true"}).close()
        return
    with site.robot(**{setting: "safety-*"}) as robot:
        assert robot.ask("start") == "success"
        async with Caller(client=await open_client(site.link)) as caller:
            await caller.sees("arm-1")
            await emit_stop(caller.client, "ef" * 16, "stranger")
            await emit_stop(caller.client, "ab" * 16, "safety-2")
            await until(lambda: robot.ask("locked"), what="the true one counts")
            told = (await caller.call("arm-1", "getStatus"))["result"]
        assert [each["source"] for each in told["lockout"]] == ["safety-2"]
