"""Reach over Device Connect on loopback: pictures, takeovers, cubes picked up and put down."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import numpy as np
from fixtures.waiting import eventually, free_port

from benchmarks.table import Row
from strands_robots.contract import RolloutEvent
from strands_robots.device_connect import FleetClient, init_device_connect_sync, loopback_config, stop_device_connect
from strands_robots.simulation import Simulation
from strands_robots.simulation.engine import BACKEND

PICTURE_MS, TAKE_MS, RATE = 25.0, 20.0, 0.95
NEAR_M, STANDING_M = 0.015, 0.003
SHOULDER_M = 0.0452
MOTION_S = 3.0


def rows(*, quick: bool) -> list[Row]:
    """Measure pictures, takeovers, and picking over the network."""
    return [pictures(50 if quick else 300), takeovers(30 if quick else 200), cubes(10 if quick else 100)]


@contextmanager
def served(world: Simulation, *names: str) -> Iterator[list[FleetClient]]:
    """Serve a world as ``arm-1``, with a client for each name."""
    link = loopback_config(free_port())
    runtime = init_device_connect_sync(world, peer_id="arm-1", link=link)
    try:
        with ExitStack() as stack:
            clients = [stack.enter_context(FleetClient(link, name)) for name in names]
            for client in clients:
                eventually(client.peers)
            yield clients
    finally:
        stop_device_connect(runtime)
        world.cleanup()


def arm_world() -> Simulation:
    """Return a world with one arm."""
    world = Simulation()
    world.add_robot("arm", "so100")
    return world


def pictures(count: int) -> Row:
    """Take pictures while nothing moves, then while a policy runs."""
    world = arm_world()
    with served(world, "agent-a") as (client,):
        took = []
        client.call("arm-1", "getPicture", {"camera": "table"})
        for _ in range(count):
            began = time.perf_counter()
            assert client.call("arm-1", "getPicture", {"camera": "table"})["status"] == "success"
            took.append(1000 * (time.perf_counter() - began))
        alone = rate(world)
        beside = rate(world, client)
    p50, kept = float(np.median(took)), beside / alone
    return Row(
        f"getPicture 640 x 480, caller to answer, {BACKEND or 'default'}; a policy's rate beside ten pictures a second",
        f"p50 {p50:.1f} ms, p95 {np.percentile(took, 95):.1f} ms; {beside:.1f} Hz",
        f"{alone:.1f} Hz without pictures",
        kept,
        f"p50 <= {PICTURE_MS:g} ms, rate >= {RATE:g}",
        p50 <= PICTURE_MS and kept >= RATE,
    )


def rate(world: Simulation, client: FleetClient | None = None) -> float:
    """Return the control steps a second of a policy, beside a client's pictures."""
    world.start_policy("arm", "wave", "mock", MOTION_S)
    while world.list_policies_running():
        if client is not None:
            client.call("arm-1", "getPicture", {"camera": "table"})
        time.sleep(0.1)
    outcome = world.outcomes()["arm"]
    return float(outcome["step_count"] / outcome["duration"])


def takeovers(count: int) -> Row:
    """Take a moving robot from its holder, and note the holder's last write."""
    world, wrote = arm_world(), [0.0]

    def note(event: RolloutEvent) -> None:
        if event.kind == "step":
            wrote[0] = time.perf_counter()

    world.subscribe(note)
    late, answered = [], []
    with served(world, "agent-a", "operator") as (agent, operator):
        for _ in range(count):
            held = agent.call("arm-1", "acquireControl")
            order = {"instruction": "wave", "duration": 60.0, "lease_id": held["lease_id"]}
            assert agent.call("arm-1", "execute", order)["status"] == "success"
            began = time.perf_counter()
            taken = operator.call("arm-1", "takeControl", {"reason": "benchmark"})
            answer = time.perf_counter()
            eventually(lambda: not world.list_policies_running())
            late.append(1000 * max(wrote[0] - began, 0.0))
            answered.append(wrote[0] <= answer)
            operator.call("arm-1", "releaseControl", {"lease_id": taken["lease_id"]})
    p99 = float(np.percentile(late, 99))
    return Row(
        f"takeControl to the last write of the old holder, {count} takeovers of a running policy",
        f"p50 {np.median(late):.1f} ms, p99 {p99:.1f} ms; {answered.count(False)} writes after the answer",
        "",
        None,
        f"p99 <= {TAKE_MS:g} ms; none",
        p99 <= TAKE_MS and all(answered),
    )


def cubes(count: int) -> Row:
    """Pick up cubes and put them down by calls over the network, in real time."""
    draw = np.random.default_rng(11)
    good = 0
    for _ in range(count):
        edge, reach, azimuth, yaw = (float(v) for v in draw.uniform((0.02, 0.16, -0.8, -3.1), (0.03, 0.26, 0.8, 3.1)))
        goal = azimuth + (0.5 if azimuth < 0 else -0.5)
        place = {"x": SHOULDER_M + 0.2 * float(np.cos(goal)), "y": 0.2 * float(np.sin(goal))}
        world = arm_world()
        at = (SHOULDER_M + reach * float(np.cos(azimuth)), reach * float(np.sin(azimuth)), edge / 2)
        world.add_object("cube", "box", (edge / 2,) * 3, at, yaw=yaw)
        with served(world, "agent-a") as (client,):
            held = client.call("arm-1", "acquireControl")
            lease = {"lease_id": held["lease_id"], "speed": 1.0}
            picked = client.call("arm-1", "pick", {"object": "cube", **lease}, 40.0)
            if picked.get("holding") is not True:
                continue
            client.call("arm-1", "place", {**place, **lease}, 40.0)
            world.step(100)
            x, y, z = (float(v) for v in world.objects("arm")[0].position)
            near = float(np.hypot(x - place["x"], y - place["y"])) < NEAR_M
            good += near and abs(z - edge / 2) < STANDING_M
    share = 100 * good / count
    return Row(
        f"pick and place over Device Connect, in real time, on the SO-100, {count} cubes of 2 to 3 cm, random yaw",
        f"{share:.0f} %",
        "",
        None,
        ">= 97 %",
        share >= 97,
    )
