"""Leading from elsewhere: takeovers, old commands, old pictures, kills and stops.

``python -m benchmarks.takeover --rows turns,stops --turns 10 --stops 10`` measures a part of it.
"""

from __future__ import annotations

import argparse
import random
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fixtures.child import Child
from fixtures.installed import install
from fixtures.stop_controller import controller
from fixtures.waiting import eventually, free_port
from rich.console import Console

from benchmarks.dataset import HALT_MS, percentile
from benchmarks.table import Row
from benchmarks.takeover_children import BEAT_S, LATENCY_S, PEER, POLICY, RANGES_PER_S
from benchmarks.takeover_lerobot import NOT_MEASURED, PYTHON, SITES, beside_lerobot, kills_ms
from benchmarks.takeover_wire import BEAT_S as WIRE_BEAT_S
from benchmarks.takeover_wire import Carried, Weather, Wire
from strands_robots.device_connect import loopback_config
from strands_robots.policies.handover import GUIDES

AWAY = 90.0
"""Farthest that the leader stands from the robot at a takeover, in degrees."""

RANGE = 200.0
"""Range of each joint of the arm, in degrees."""

STEP_MAX = RANGE * RANGES_PER_S * BEAT_S
"""What a joint may move in a beat."""

WAYS_S, LOSSES = (0.0, 0.025, 0.075), (0.0, 0.05)
STEADY_S = 600.0
SLOW = {"max_speed": 0.2}
"""Options of a lead whose robot is still on its way when the leader or its camera fails."""

ROWS = "turns, wire, pictures, kills, lerobot-kills, lerobot, stops"
FAULTS = ("freezes", "repeats", "lags")
PICTURE_MS, STOP_MS = 350.0, 20.0
STATES = ("policy", "led", "held")
SETTLED_S = 0.06
"""After a stop: a write that came as late as this is still its last one."""


@dataclass(frozen=True, slots=True)
class Sizes:
    """How much is measured."""

    turns: int = 200
    commands: int = 10_000
    pictures: int = 10
    """Failures of each kind."""

    kills: int = 100
    stops: int = 100
    """Stops in each state."""

    recordings: int = 2
    """Recordings by ``lerobot-record`` of each side."""

    recorded: int = 15
    """Seconds of each."""


QUICK = Sizes(turns=10, commands=2000, pictures=1, kills=3, stops=5, recordings=1, recorded=5)


def run(*, quick: bool = False, sizes: Sizes | None = None, rows: Sequence[str] = ()) -> list[Row]:
    """Measure and return the rows of this part, or those that are named."""
    size = sizes or (QUICK if quick else Sizes())
    parts: dict[str, Callable[[Sizes], list[Row]]] = {
        "turns": turned,
        "wire": wired,
        "pictures": pictured,
        "kills": killed,
        "lerobot-kills": lerobot_killed,
        "lerobot": lambda size: beside_lerobot(size.recordings, size.recorded),
        "stops": stopped,
    }
    return [row for name, measure in parts.items() if not rows or name in rows for row in measure(size)]


@dataclass
class Site:
    """A served robot, and how its leaders reach it."""

    robot: Child
    port: int
    environment: Mapping[str, str]

    @contextmanager
    def leader(self) -> Iterator[Child]:
        """Yield a leader of a process of its own."""
        order = {"part": "leader", "port": self.port}
        with Child("benchmarks.takeover_children", order, self.environment, forked=False) as leader:
            yield leader
            if leader.exit_code is None:
                leader.ask("end")


@contextmanager
def site(file: str = "") -> Iterator[Site]:
    """Yield a robot with the policy of this benchmark."""
    with tempfile.TemporaryDirectory(prefix="bench-takeover-") as folder, ExitStack() as stack:
        Path(folder).chmod(0o700)
        install(
            Path(folder) / "installed",
            "bench-computed",
            "from benchmarks.takeover_children import computed\n",
            {"strands_robots.policies": {POLICY: "benchmarks.takeover_children:computed"}},
        )
        paths = [str(Path(folder) / "installed"), *sys.path]
        environment = {
            "STRANDS_STATE_DIR": folder,
            "PYTHONPATH": ":".join(each for each in paths if each),
            "DEVICE_CONNECT_RPC_ALLOW": "*",
            "STRANDS_ROBOT_COMMAND_ALLOW": "acquireControl,lead",
        }
        port = free_port()
        order = {"part": "robot", "port": port, "file": str(Path(folder) / file) if file else ""}
        robot = stack.enter_context(Child("benchmarks.takeover_children", order, environment, forked=False))
        eventually(lambda: robot.ask("ready"), 20, "the robot's links")
        yield Site(robot, port, environment)


def turned(size: Sizes) -> list[Row]:
    """Take over from a policy and give back."""
    draw, takeovers, jumps, backs, held = random.Random(7), list[float](), list[float](), list[float](), 0
    with site("turns.mcap") as there, there.leader() as leader:
        for guide in GUIDES:
            leader.ask("finish")
            there.robot.ask("clear")
            leader.ask("lead", {"guide": guide, "policy_provider": POLICY, "instruction": "sweep"})
            eventually(lambda: leader.ask("state")[0] == "policy", 10, "the policy")
            for _ in range(size.turns // len(GUIDES)):
                held += policy_drives(leader)
                # Longer than an inference: each turn of the policy begins with nothing under way.
                time.sleep(draw.uniform(1.5, 3) * LATENCY_S)
                there.robot.ask("steps")
                gripped = leader.ask("grip", draw.uniform(-AWAY, AWAY))
                time.sleep(draw.uniform(1.5, 3) * LATENCY_S)
                back = leader.ask("give_back")
                time.sleep(LATENCY_S + 0.2)
                steps = there.robot.ask("steps")
                led = [(at, jump) for at, led_by, jump in steps if led_by and at > gripped]
                own = [at for at, led_by, _ in steps if not led_by and at > back]
                took = [seconds for began, seconds in there.robot.ask("inferences") if began > back]
                if leader.ask("state")[0] != "policy" or not led or not own or not took:
                    held += 1
                    continue
                takeovers.append(led[0][0] - gripped)
                jumps.append(led[0][1])
                backs.append(own[0] - back - took[0])
        leader.ask("finish")
        made, recorded = there.robot.ask("end")
    return [takeover_row(takeovers, jumps, held), back_row(backs, made, recorded)]


def policy_drives(leader: Child) -> int:
    """Return once the policy drives; count the holds before."""
    held = 0
    while leader.ask("state")[0] != "policy":
        held += 1
        leader.ask("give_back")
        time.sleep(0.3)
    return min(held, 1)


def taken_over(leader: Child, away: float, sweeps: bool = False) -> None:
    """Take over, again where a busy machine has it held, and return once the leader leads."""
    while True:
        leader.ask("grip", away, sweeps)
        time.sleep(0.1)
        if leader.ask("state")[0] == "led":
            return


def takeover_row(takeovers: Sequence[float], jumps: Sequence[float], held: int) -> Row:
    """Return the row of takeovers, in seconds and degrees; ``held`` more met a hold of a busy machine."""
    late = 1000 * percentile(takeovers, 1.0)
    return Row(
        f"{len(takeovers)} takeovers from a policy, both guides, the leader up to {AWAY:g} degrees away: press to its "
        "first applied action; jump",
        f"p50 {1000 * percentile(takeovers, 0.5):.0f} p99 {1000 * percentile(takeovers):.0f} worst {late:.0f} ms; "
        f"jump at most {max(jumps):.2f} degrees; "
        f"{held} more met a hold",
        "",
        None,
        f"p99 ≤ {2000 * BEAT_S:g} ms, 2 beats; jump ≤ {STEP_MAX:g} degrees, a beat of the speed bound",
        percentile(takeovers) <= 2 * BEAT_S and max(jumps) <= STEP_MAX + 1e-6,
    )


def back_row(backs: Sequence[float], made: int, recorded: int) -> Row:
    """Return the row of what follows a turn of the leader.

    Args:
        backs: seconds from the press to the policy's first action, without those of its inference.
        made: steps of the robot.
        recorded: how many of them its recording has.
    """
    return Row(
        f"{len(backs)} times given back to a policy of {800 * LATENCY_S:.0f} to {1200 * LATENCY_S:.0f} ms: press to "
        "its first action, without its inference; frames of the robot's recording",
        f"p50 {1000 * percentile(backs, 0.5):.0f} p99 {1000 * percentile(backs):.0f} worst {1000 * max(backs):.0f} ms; "
        f"{made - recorded} of {made} frames lost",
        "",
        None,
        f"p99 ≤ {2000 * BEAT_S:g} ms, 2 beats; 0 lost",
        percentile(backs) <= 2 * BEAT_S and made == recorded,
    )


def wired(size: Sizes) -> list[Row]:
    """Lead over wires that are computed."""
    steady = int(STEADY_S / WIRE_BEAT_S * min(1.0, size.commands / Sizes().commands))
    rows = []
    for way in WAYS_S:
        runs = [Wire(Weather(way, loss)).run(size.commands) for loss in LOSSES]
        rows.append(wire_row(way, runs, Wire(Weather(way, faults=False)).run(steady)))
    return rows


def wire_row(way_s: float, runs: Sequence[Carried], steady: Carried) -> Row:
    """Return the row of one way: runs with faults, and a steady one without loss."""
    stale, carried, dropped = (sum(getattr(run, name) for run in runs) for name in ("stale", "carried", "dropped"))
    oldest = 1000 * max(run.oldest_s for run in runs)
    each = " and ".join(f"{100 * loss:g} %" for loss in LOSSES)
    return Row(
        f"{runs[0].sent} commands late, doubled, reordered, replayed after outages, {1000 * way_s:g} ± 5 ms one way, "
        f"{each} loss, time computed; and {steady.sent * WIRE_BEAT_S / 60:g} minutes without faults",
        f"{stale} stale carried out of {carried}, the oldest {oldest:.0f} ms at its arrival; {dropped} dropped; "
        f"{steady.holds} false holds",
        "",
        None,
        f"0 stale, beyond {1000 * way_s:g} ± 5 + 100 ms; 0 false holds",
        not stale and carried > 0 and not steady.holds,
    )


def pictured(size: Sizes) -> list[Row]:
    """Drive by a camera that fails."""
    late: dict[str, list[float]] = {fault: [] for fault in FAULTS}
    moments, whys, away = random.Random(7), set[str](), AWAY
    with site() as there, there.leader() as leader:
        for fault in FAULTS:
            for _ in range(size.pictures):
                leader.ask("lead", SLOW)
                leader.ask("grip", -away)
                away = -away
                true_at = leader.ask("watch", moments.uniform(0.5, 0.8), fault)
                time.sleep(SETTLED_S)
                whys.add(leader.ask("state")[1].split(" is ")[0])
                _, moved, _ = there.robot.ask("writes")
                late[fault].append(1000 * (moved - true_at))
                leader.ask("finish")
                there.robot.ask("clear")
    return [picture_row(late, whys)]


def picture_row(late: Mapping[str, Sequence[float]], whys: set[str]) -> Row:
    """Return the row of cameras; ``late`` has the ms from the last true picture to the last motion."""
    each = ", ".join(f"{fault} {max(took):.0f}" for fault, took in late.items())
    worst = max(max(took) for took in late.values())
    return Row(
        f"a camera freezes, repeats its last pictures, lags by a second, {len(next(iter(late.values())))} times each: "
        "last true picture to the last motion, loopback",
        f"worst in ms: {each}",
        "",
        None,
        f"≤ {PICTURE_MS:g} ms, held for the picture",
        worst <= PICTURE_MS and whys == {"the newest picture of hand"},
    )


def killed(size: Sizes) -> list[Row]:
    """Kill leaders at random moments."""
    moments, late, away = random.Random(7), list[float](), AWAY
    with site() as there:
        while len(late) < size.kills:
            with there.leader() as leader:
                leader.ask("lead", SLOW)
                away = -away
                taken_over(leader, away)
                time.sleep(moments.uniform(0.1, 0.4))
                at = time.monotonic()
                leader.kill()
            time.sleep(HALT_MS / 1000 + 2 * SETTLED_S)
            last, moved, _ = there.robot.ask("writes")
            assert last > at, "the hold is written at each beat"
            if moved > at:
                # Else a busy machine had it held before.
                late.append(1000 * (moved - at))
            there.robot.ask("halt")
            there.robot.ask("clear")
    return [kill_row("the leader", late)]


def lerobot_killed(size: Sizes) -> list[Row]:
    """Kill ``lerobot-record`` at random moments."""
    if not PYTHON.exists():
        return [Row("SIGKILL of lerobot-record", NOT_MEASURED, "", None, "", ok=True)]
    with ExitStack() as stack:
        return [kill_row("lerobot-record", kills_ms([stack.enter_context(site()) for _ in range(SITES)], size.kills))]


def kill_row(what: str, late: Sequence[float]) -> Row:
    """Return the row of kills, in ms from each to the last motion."""
    return Row(
        f"SIGKILL of {what} at {len(late)} random moments: kill to the last motion, loopback",
        f"p50 {percentile(late, 0.5):.0f} p99 {percentile(late):.0f} worst {max(late):.0f} ms",
        "",
        None,
        f"≤ {HALT_MS:g} ms",
        max(late) <= HALT_MS,
    )


def stopped(size: Sizes) -> list[Row]:
    """Stop the robot in each state of a lead."""
    moments, took = random.Random(7), {state: list[float]() for state in STATES}
    with site() as there, there.leader() as leader, ExitStack() as stack:
        hand = stack.enter_context(controller(loopback_config(there.port), environment=there.environment))
        eventually(lambda: hand.ask("up"), 20, "the controller's link")
        for state in [each for each in STATES for _ in range(size.stops)]:
            leader.ask("lead", {"policy_provider": POLICY, "instruction": "sweep"})
            eventually(lambda: leader.ask("state")[0] == "policy" and there.robot.ask("writes")[2], 10, "the policy")
            if state != "policy":
                taken_over(leader, 0.0, True)
            if state == "held":
                leader.ask("be_silent")
            time.sleep(0.3 + moments.uniform(0, BEAT_S))
            report = hand.ask("stop", [PEER])
            assert report["ok"], report
            time.sleep(SETTLED_S)
            last, _, _ = there.robot.ask("writes")
            assert last > report["at"] - 5 * BEAT_S, "it was writing in this state"
            took[state].append(max(0.0, 1000 * (last - report["at"])))
            leader.ask("finish")
            there.robot.ask("clear")
    return [stop_row(took)]


def stop_row(took: Mapping[str, Sequence[float]]) -> Row:
    """Return the row of stops, in ms by state."""
    each = "; ".join(f"{state} p50 {percentile(ms, 0.5):.1f} p99 {percentile(ms):.1f}" for state, ms in took.items())
    return Row(
        f"Stop in each state, press to last write, {len(next(iter(took.values())))} times each",
        f"{each} ms",
        "",
        None,
        f"p99 ≤ {STOP_MS:g} ms in each",
        all(percentile(ms) <= STOP_MS for ms in took.values()),
    )


def main() -> None:
    """Measure the rows that are named and print them; exit with 1 where a bound is missed."""
    from benchmarks.__main__ import shown  # noqa: PLC0415 - of this command alone

    usual = Sizes()
    parser = argparse.ArgumentParser(prog="python -m benchmarks.takeover", description=__doc__)
    parser.add_argument("--rows", default="", help=f"{ROWS}, with commas (all)")
    for name in Sizes.__slots__:
        parser.add_argument(f"--{name}", type=int, default=getattr(usual, name))
    options: dict[str, Any] = vars(parser.parse_args())
    named = [each for each in options.pop("rows").split(",") if each]
    rows = run(sizes=Sizes(**options), rows=named)
    Console().print(shown("Taking over from a policy", rows))
    sys.exit(0 if all(row.ok for row in rows) else 1)


if __name__ == "__main__":
    main()
