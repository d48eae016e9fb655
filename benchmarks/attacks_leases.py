"""Attacks on control leases: robots that hang beside healthy ones, and a take that is played again."""

from __future__ import annotations

from contextlib import ExitStack, suppress
from typing import Any

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from fixtures.child import Child
from fixtures.leased_robots import leased_robots
from fixtures.nats_server import NatsServer
from fixtures.waiting import eventually

from benchmarks.attacks_robots import state_folder
from benchmarks.table import Row
from strands_robots.device_connect import FleetClient, LinkConfig
from strands_robots.safety import ed25519
from strands_robots.safety.resume import sign_take

WEDGED, HEALTHY = 40, 10
TTL_S, LOST_AFTER_S = 3.0, 15.0
KILLS, KILLS_QUICK = 10, 1
RESTARTS, RESTARTS_QUICK = 20, 5
LATE_S = 0.05

OPEN = {"DEVICE_CONNECT_RPC_ALLOW": "*", "BYPASS_TOOL_CONSENT": "true"}


def rows(quick: bool) -> list[Row]:
    """Measure and give the rows of the table."""
    kills, restarts = (KILLS_QUICK, RESTARTS_QUICK) if quick else (KILLS, RESTARTS)
    wedges = (("status", "status read"), ("halt", "halt"))
    return [*(_wedged_row(wedge, name, kills) for wedge, name in wedges), _replayed_row(restarts)]


def _wedged_row(wedge: str, name: str, kills: int) -> Row:
    """Holders that are killed while forty of their robots hang; the halts of the others."""
    late = [each for _ in range(kills) for each in _lateness(wedge)]
    halted = sorted(each for each in late if each is not None)
    worst = f"p50 {halted[len(halted) // 2] * 1e3:.1f} ms, worst {halted[-1] * 1e3:.1f} ms" if halted else "none"
    return Row(
        f"a killed holder of {HEALTHY} healthy robots and {WEDGED} whose {name} hangs, in one process",
        f"{len(halted)} of {len(late)} healthy ones halted after the end of their lease: {worst}",
        "",
        None,
        f"each at most {LATE_S * 1e3:.0f} ms after it",
        len(halted) == len(late) and halted[-1] <= LATE_S,
    )


def _lateness(wedge: str) -> list[float | None]:
    """Return for each healthy robot the seconds from the end of its lease to its standstill, None if it moves on."""
    healthy = [f"arm-{number}" for number in range(HEALTHY)]
    robots = {f"hangs-{number}": wedge for number in range(WEDGED)} | dict.fromkeys(healthy, "")
    due: dict[str, float] = {}
    with ExitStack() as stack:
        server = stack.enter_context(NatsServer())
        site = stack.enter_context(leased_robots(server.url, robots, OPEN))
        holder = stack.enter_context(Child("fixtures.lease_holder", {"url": server.url}))
        if holder.ask("move", list(robots), TTL_S) != ["success"] * len(robots):
            raise RuntimeError("a robot was not moved")
        site.ask("hang")
        holder.kill()

        def halted() -> bool:
            due.update({name: at for name, at in site.ask("due").items() if at is not None})
            still = site.ask("still")
            return all(still[name] for name in healthy)

        with suppress(AssertionError):  # what moves on by then is counted as such
            eventually(halted, TTL_S + LOST_AFTER_S)
        still = site.ask("still")
    return [still[name] - due[name] if still[name] else None for name in healthy]


def _replayed_row(restarts: int) -> Row:
    """One recorded take, played again after each restart of the robot's process."""
    key, refused = Ed25519PrivateKey.generate(), 0
    with ExitStack() as stack:
        server = stack.enter_context(NatsServer())
        operator = stack.enter_context(FleetClient(LinkConfig(transport="nats", connect=(server.url,)), "operator"))
        public = ed25519.encode(ed25519.public_half(key))
        state = {"STRANDS_STATE_DIR": str(state_folder(stack)), "STRANDS_MESH_RESUME_PUBLIC_KEY": public}

        def start() -> Child:
            return stack.enter_context(leased_robots(server.url, {"arm-1": ""}, OPEN | state))

        def call(verb: str, **arguments: Any) -> dict[str, Any]:
            return dict(operator.call("arm-1", verb, arguments))

        robot = start()
        eventually(operator.peers)
        recorded = sign_take(key, "arm-1", call("getControl")["epoch"])
        taken = call("takeControl", reason="measured", assertion=recorded)["status"] == "success"
        for _ in range(restarts):
            robot.kill()
            robot = start()
            refused += call("takeControl", reason="played again", assertion=recorded)["status"] == "error"
    return Row(
        "a recorded take, played again after each restart of the robot's process",
        f"{refused} of {restarts} refused",
        "",
        None,
        "the first one takes, each later one is refused",
        taken and refused == restarts,
    )
