"""Calls and events of one small device, on our backend and on the framework's own, side by side.

Every figure that is compared comes from the same caller process, in turns, so that what else the machine does falls
on both. The devices are processes of their own.
"""

from __future__ import annotations

import asyncio
import contextlib
import statistics
import tempfile
import time
from collections.abc import AsyncIterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from fixtures.bare_caller import Caller
from fixtures.echo_device import EchoDevice
from fixtures.nats_server import NatsServer
from fixtures.waiting import free_port, until
from fixtures.zenoh_router import ZenohRouter

from benchmarks.table import Row
from strands_robots.device_connect.backends import LinkConfig, open_client

IN_FLIGHT = 32
EVENT_HZ = 10_000.0
CROWD_STRETCH = 8 * IN_FLIGHT
BOTH_ENDS = {"Zenoh D2D": 0.5, "Zenoh router": 0.55, "NATS": 0.5}


@dataclass(frozen=True, slots=True)
class Effort:
    """Extent of a measurement: for a figure to quote, or a quick look."""

    turns: int
    calls: int
    event_seconds: float
    stops: int


FULL = Effort(turns=5, calls=2_000, event_seconds=5.0, stops=50)
QUICK = Effort(turns=3, calls=300, event_seconds=1.0, stops=10)


@dataclass(frozen=True, slots=True)
class Pair:
    """The same device twice, each with a caller that reaches it, and both with callers of their own kind."""

    name: str
    ours: Caller
    bare: Caller
    ours_both: Caller
    device_ours: str = "ours"
    device_bare: str = "bare"


def run(quick: bool = False) -> list[Row]:
    """Measure and give the rows of the table."""
    return asyncio.run(_run(QUICK if quick else FULL))


async def _run(effort: Effort) -> list[Row]:
    rows = []
    for name, opened in (("Zenoh D2D", _d2d()), ("Zenoh router", _router()), ("NATS", _nats())):
        async with opened as pair:
            rows += await _round_trips(name, pair, effort)
            rows += await _in_flight(name, pair, effort)
            rows += await _while_moving(name, pair, effort)
            rows += await _events(name, pair, effort)
    return rows + await _own_robot(effort)


async def _own_robot(effort: Effort) -> list[Row]:
    """A robot of four methods asked by a bare caller: beside the bare echo, and beside the robot on a bare device."""
    calls = f"getStatus of a robot of one's own, Zenoh D2D, {effort.calls} calls, a bare caller"
    rows = []
    for bare_robot, beside, bounds in (
        (False, "", (0.85, 1.15)),
        (True, ", beside the robot on a bare device that asks it off its loop", (1.0, 1.15)),
    ):
        with tempfile.TemporaryDirectory() as state:
            environment = {"STRANDS_STATE_DIR": state}
            async with _d2d(own_robot=True, bare_robot=bare_robot, environment=environment) as pair:
                sides = ((pair.bare, pair.device_bare), (pair.ours, pair.device_ours))
                bare, ours = await _in_turns(sides, effort)
        rows += [
            _compared(f"{calls}{beside}, p{percent}", _median(ours, percent), _median(bare, percent), bound)
            for percent, bound in zip((50, 99), bounds, strict=True)
        ]
    return rows


async def _round_trips(name: str, pair: Pair, effort: Effort) -> list[Row]:
    sides = ((pair.bare, pair.device_bare), (pair.ours, pair.device_ours), (pair.ours_both, pair.device_ours))
    bare, ours, both = await _in_turns(sides, effort)
    bound = 1.1 if name == "NATS" else 1.0
    calls = f"getStatus, {name}, {effort.calls} calls"
    rows = [
        _compared(f"{calls}, p50", _median(ours, 50), _median(bare, 50), bound),
        _compared(f"{calls}, p99", _median(ours, 99), _median(bare, 99), 1.15),
    ]
    rows.append(_compared(f"{calls}, ours at both ends, p50", _median(both, 50), _median(bare, 50), BOTH_ENDS[name]))
    return rows


async def _in_turns(sides: Sequence[tuple[Caller, str]], effort: Effort) -> list[list[list[float]]]:
    turns: list[list[list[float]]] = [[] for _ in sides]
    for _ in range(effort.turns):
        for kept in turns:
            kept.append([])
        # Call by call in turns: what else the machine does for a moment falls on all of them.
        for number in range(effort.calls):
            for place in range(len(sides)):
                side = (number + place) % len(sides)
                turns[side][-1].append(await _timed(*sides[side], "getStatus"))
    return turns


async def _in_flight(name: str, pair: Pair, effort: Effort) -> list[Row]:
    """Our caller asks both devices, because the framework's own is slower than either of them."""
    bound = 0.9 if name == "NATS" else 1.2
    rows = []
    for kind, to_ours, to_bare in (
        ("one caller of ours", pair.ours_both, pair.ours_both),
        ("one bare caller", pair.ours, pair.bare),
    ):
        ours, bare = [], []
        for _ in range(effort.turns * effort.calls // CROWD_STRETCH):
            bare.append(await _rate(to_bare, pair.device_bare, CROWD_STRETCH))
            ours.append(await _rate(to_ours, pair.device_ours, CROWD_STRETCH))
        fast, slow = statistics.median(ours), statistics.median(bare)
        ratio = fast / slow
        decides = to_ours is pair.ours_both
        rows.append(
            Row(
                f"{IN_FLIGHT} calls in flight, {name}, {kind}",
                f"{fast:,.0f}/s",
                f"{slow:,.0f}/s",
                ratio,
                f"≥ {bound:g}" if decides else "for information, the caller is the limit",
                ratio >= bound or not decides,
            )
        )
    return rows


async def _while_moving(name: str, pair: Pair, effort: Effort) -> list[Row]:
    """A bare caller would wait in its own four threads, so both devices are asked by our client."""
    took = []
    moving = asyncio.ensure_future(pair.ours_both.call(pair.device_ours, "move", {"seconds": 2.0}, wait_s=20))
    await asyncio.sleep(0.1)
    for _ in range(effort.stops):
        took.append(await _timed(pair.ours_both, pair.device_ours, "stop"))
        await asyncio.sleep(0.02)
    await moving
    other = asyncio.ensure_future(pair.bare.call(pair.device_bare, "move", {"seconds": 2.0}, wait_s=20))
    await asyncio.sleep(0.1)
    against = await _timed(pair.bare, pair.device_bare, "stop")
    await other
    worst = _percentile(took, 99)
    return [
        Row(
            f"stop while a 2 s call of the same device runs, {name}, p99",
            _ms(worst),
            _ms(against),
            worst / against,
            "≤ 20 ms",
            worst <= 0.02,
        )
    ]


async def _events(name: str, pair: Pair, effort: Effort) -> list[Row]:
    count = round(EVENT_HZ * effort.event_seconds)
    lost = {}
    for caller, device in ((pair.ours, pair.device_ours), (pair.bare, pair.device_bare)):
        received = await caller.collect(device, "tick")
        await asyncio.sleep(0.5)
        await caller.call(device, "burst", {"count": count, "hz": EVENT_HZ})
        await asyncio.sleep(effort.event_seconds)
        with contextlib.suppress(AssertionError):  # the bare device has dropped the rest
            await until(partial(_reached, received, count), within=effort.event_seconds + 5)
        lost[device] = count - len(received)
    ours, bare = lost[pair.device_ours], lost[pair.device_bare]
    return [
        Row(
            f"events lost of {count:,} at 10 kHz, {name}",
            f"{ours:,}",
            f"{bare:,}",
            ours / bare if bare else None,
            "0",
            ours == 0,
        )
    ]


@contextlib.asynccontextmanager
async def _d2d(
    *, own_robot: bool = False, bare_robot: bool = False, environment: Mapping[str, str] | None = None
) -> AsyncIterator[Pair]:
    """Peers without a router; callers reach them at the endpoint each listens on."""
    here, there = (f"tcp/127.0.0.1:{free_port()}" for _ in range(2))
    alone = LinkConfig(mode="peer", listen=(here,), multicast=False)
    ours = EchoDevice("ours", alone, environment, own_robot=own_robot)
    stock = {"ZENOH_LISTEN": there, "DEVICE_CONNECT_DISCOVERY_MODE": "d2d"}
    bare = EchoDevice("bare", environment=stock, own_robot=bare_robot)
    both = LinkConfig(mode="peer", connect=(here, there), multicast=False)
    with ours, bare:
        async with (
            Caller(servers=(here,)) as one,
            Caller(servers=(there,)) as other,
            Caller(client=await open_client(both)) as own,
        ):
            yield await _met(Pair("Zenoh D2D", one, other, own))


@contextlib.asynccontextmanager
async def _router() -> AsyncIterator[Pair]:
    with ZenohRouter() as router:
        link = LinkConfig(connect=(router.endpoint,))
        stock = {"ZENOH_CONNECT": router.endpoint, "DEVICE_CONNECT_DISCOVERY_MODE": "d2d"}
        with EchoDevice("ours", link), EchoDevice("bare", environment=stock):
            async with Caller(servers=(router.endpoint,)) as caller, Caller(client=await open_client(link)) as own:
                yield await _met(Pair("Zenoh router", caller, caller, own))


@contextlib.asynccontextmanager
async def _nats() -> AsyncIterator[Pair]:
    with NatsServer() as server:
        link = LinkConfig("nats", connect=(server.url,))
        stock = {"NATS_URL": server.url, "DEVICE_CONNECT_DISCOVERY_MODE": "d2d"}
        with EchoDevice("ours", link), EchoDevice("bare", environment=stock):
            async with (
                Caller("nats", servers=(server.url,)) as caller,
                Caller(client=await open_client(link)) as own,
            ):
                yield await _met(Pair("NATS", caller, caller, own))


async def _met(pair: Pair) -> Pair:
    for caller, device in (
        (pair.ours, pair.device_ours),
        (pair.bare, pair.device_bare),
        (pair.ours_both, pair.device_ours),
        (pair.ours_both, pair.device_bare),
    ):
        await caller.sees(device)
        await _latencies(caller, device, 50)
    return pair


def _reached(received: list[dict[str, Any]], count: int) -> bool:
    return len(received) >= count


async def _latencies(caller: Caller, device: str, calls: int) -> list[float]:
    return [await _timed(caller, device, "getStatus") for _ in range(calls)]


async def _timed(caller: Caller, device: str, method: str) -> float:
    started = time.perf_counter()
    answer = await caller.call(device, method, wait_s=20)
    took = time.perf_counter() - started
    if "result" not in answer:
        raise RuntimeError(f"{device} answered {answer}")
    return took


async def _rate(caller: Caller, device: str, calls: int) -> float:
    async def one_of_many() -> None:
        for _ in range(calls // IN_FLIGHT):
            await _timed(caller, device, "getStatus")

    started = time.perf_counter()
    await asyncio.gather(*(one_of_many() for _ in range(IN_FLIGHT)))
    return calls // IN_FLIGHT * IN_FLIGHT / (time.perf_counter() - started)


def _compared(what: str, ours: float, against: float, bound: float) -> Row:
    ratio = ours / against
    return Row(what, _ms(ours), _ms(against), ratio, f"≤ {bound:g}", ratio <= bound)


def _median(turns: list[list[float]], percent: int) -> float:
    return statistics.median(_percentile(turn, percent) for turn in turns)


def _percentile(values: list[float], percent: int) -> float:
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, len(ordered) * percent // 100)]


def _ms(seconds: float) -> str:
    return f"{seconds * 1000:.2f} ms"
