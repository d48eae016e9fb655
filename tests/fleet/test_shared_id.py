"""One id on two networks: which robot a motion goes to, for how long that counts, and a robot that has moved on."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from fixtures.waiting import eventually
from tests.fleet.scripted import OURS, ScriptedNetwork

from strands_robots import errors
from strands_robots.fleet import shared_id
from strands_robots.fleet.adapter import DEVICE_CONNECT, MESH
from strands_robots.fleet.fleet import Fleet
from strands_robots.fleet.networks import Networks
from strands_robots.safety.identity import ROBOTS, KeyFile, SigningIdentity


@pytest.fixture
def near() -> ScriptedNetwork:
    return ScriptedNetwork(DEVICE_CONNECT, {"both": OURS})


@pytest.fixture
def far() -> ScriptedNetwork:
    return ScriptedNetwork(MESH, {"both": OURS})


@pytest.fixture
def fleet(near: ScriptedNetwork, far: ScriptedNetwork) -> Iterator[Fleet]:
    with Fleet([near, far]) as joined:
        yield joined


@pytest.fixture
def keys(tmp_path: Path) -> list[SigningIdentity]:
    return [KeyFile(ROBOTS, name, tmp_path).load_or_make() for name in ("one", "two")]


def moves(network: ScriptedNetwork) -> int:
    return [call[1] for call in network.calls].count("moveTo")


def leave(network: ScriptedNetwork, monkeypatch: pytest.MonkeyPatch) -> None:
    """Have a robot leave a network that still believes to have it."""
    del network.robots["both"]
    monkeypatch.setattr(network, "bears", lambda robot: True)


def test_decision_is_made_anew_after_a_while(
    fleet: Fleet,
    near: ScriptedNetwork,
    far: ScriptedNetwork,
    keys: list[SigningIdentity],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    near.sign_with(keys[0])
    far.sign_with(keys[0])
    both = fleet["both"]
    both.move_to(x=1)
    # Another process takes the id on Device Connect, which has no sessions.
    near.sign_with(keys[1])
    both.move_to(x=2)
    assert moves(near) == 2
    monkeypatch.setattr(shared_id, "DECIDED_S", 0.0)
    with pytest.raises(errors.AmbiguousRobotError):
        both.move_to(x=3)


CALLS: list[Callable[[Fleet, str, dict[str, Any]], Any]] = [
    lambda fleet, verb, given: fleet["both"].call(verb, **given),
    lambda fleet, verb, given: fleet._networks.call("both", verb, given, 5.0, moves=verb == "moveTo"),
    lambda fleet, verb, given: asyncio.run(
        fleet._networks.call_async("both", verb, given, 5.0, moves=verb == "moveTo")
    ),
]


@pytest.mark.parametrize("call", CALLS)
@pytest.mark.parametrize(("verb", "given"), [("getStatus", {}), ("moveTo", {"x": 1})])
def test_robot_that_has_left_one_network_is_called_on_the_other(
    call: Callable[[Fleet, str, dict[str, Any]], Any],
    verb: str,
    given: dict[str, Any],
    fleet: Fleet,
    near: ScriptedNetwork,
    far: ScriptedNetwork,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert fleet["both"].network == DEVICE_CONNECT
    leave(near, monkeypatch)
    assert call(fleet, verb, given)["status"] == "success"
    assert [each[1] for each in far.calls][-1] == verb


def test_motion_goes_to_no_twin_of_a_robot_that_is_enrolled_on_a_network_that_is_down(
    near: ScriptedNetwork, far: ScriptedNetwork, keys: list[SigningIdentity]
) -> None:
    far.unreachable, far.enrolled = "no hub", {"both": keys[0].public}
    near.sign_with(keys[1])
    with Fleet([near, far]) as fleet:
        both = fleet["both"]
        refused = "enrolled on mesh, which is not joined"
        with pytest.raises(errors.AmbiguousRobotError, match=refused):
            both.move_to(x=1)
        with pytest.raises(errors.AmbiguousRobotError, match=refused):
            fleet._networks.call("both", "moveTo", {"x": 1}, 5.0)
        assert both.status()["status"] == "success"
        assert both.halt().stopped is True
        assert moves(near) == 0
        near.sign_with(keys[0])
        both.move_to(x=1)
        assert moves(near) == 1


def test_waiting_motions_take_no_thread_of_the_loop(
    near: ScriptedNetwork, far: ScriptedNetwork, monkeypatch: pytest.MonkeyPatch
) -> None:
    near.robots.clear()
    released = threading.Event()
    monkeypatch.setattr(far, "reaches", lambda robot: released.wait(30))

    async def work(networks: Networks) -> None:
        asyncio.get_running_loop().set_default_executor(ThreadPoolExecutor(1))
        waiting = [asyncio.ensure_future(networks.of_async("both", "moveTo", moves=True)) for _ in range(40)]
        try:
            await asyncio.wait(waiting, timeout=0.1)
            assert await asyncio.wait_for(asyncio.to_thread(lambda: "free"), 30) == "free"
            assert list(await asyncio.wait_for(networks.stop_async("both"), 30)) == [MESH]
            assert not any(each.done() for each in waiting)
        finally:
            released.set()
        assert await asyncio.gather(*waiting) == [far] * 40

    before = threading.enumerate()
    with Networks([near, far]) as networks:
        networks.settled()
        asyncio.run(work(networks))
    eventually(
        lambda: not [each for each in threading.enumerate() if each.name.startswith("networks") and each not in before],
        what="the end of the threads",
    )


def test_motion_of_a_robot_that_has_left_both_networks_finds_none(
    fleet: Fleet, near: ScriptedNetwork, far: ScriptedNetwork, monkeypatch: pytest.MonkeyPatch
) -> None:
    both = fleet["both"]
    assert "moveTo" in both.verbs
    leave(near, monkeypatch)
    leave(far, monkeypatch)
    with pytest.raises(errors.NoSuchRobotError, match="any more"):
        both.move_to(x=1)


def test_robot_that_left_one_network_is_not_called_on_another_one_where_it_is_silent(
    near: ScriptedNetwork, far: ScriptedNetwork, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Networks([near, far]) as joined:
        joined.settled()
        assert joined.instead("both", "moveTo", near, moves=False) is far
        silent_for = 4 * far.beats_every("both")
        monkeypatch.setattr(far, "beats", lambda robots: dict.fromkeys(robots, time.monotonic() - silent_for))
        assert joined.instead("both", "moveTo", near, moves=False) is None
