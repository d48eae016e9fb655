"""Motions of one MCP client, and what halts them."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from typing import Any

import pytest
from tests.fleet.scripted import ScriptedNetwork

from strands_robots.envelope import Envelope, error, is_error, success, text_of
from strands_robots.errors import (
    LockoutError,
    NoAnswerError,
    NoSuchRobotError,
    RefusalError,
    UnknownVerbError,
    UnreachableError,
)
from strands_robots.fleet.adapter import DEVICE_CONNECT, MESH, STOP_S, FoundRobot, NetworkAdapter
from strands_robots.fleet.networks import Networks
from strands_robots.mcp import caller as module
from strands_robots.mcp.caller import Caller
from strands_robots.serving.advertised import AdvertisedVerb, find_verb

RUNNING = success("under way", task_id="moveTo-1", task_status="running")


def description(*parameters: str) -> tuple[dict[str, Any], ...]:
    """Return the functions of a robot whose verbs have these parameters."""
    properties = {name: {"type": "string", "description": "As lease_ttl_s."} for name in parameters}
    schema = {"type": "object", "properties": properties}
    return tuple({"name": verb, "parameters": schema} for verb in ("moveTo", "execute", "start"))


class FakeNetwork(ScriptedNetwork):
    """A network whose robot gives the answers, or raises the refusals, that a test sets."""

    def __init__(self, name: str = DEVICE_CONNECT, **answers: Envelope | Exception) -> None:
        super().__init__(name, {"arm-1": description(), "bar-1": description()})
        self.starts = "start" if name == MESH else "execute"
        self.given: dict[str, Envelope | Exception] = dict(answers)
        self.described: object = None
        self.descriptions = 0
        self.stop_answers = [success("Stopped.", stopped=True)]
        self.stop_count = 0

    def sent(self, verb: str) -> dict[str, Any]:
        """Return the parameters of the last call of a verb."""
        return next(params for _, name, params, _ in reversed(self.calls) if name == verb)

    @property
    def verbs(self) -> list[str]:
        """The verbs that were called."""
        return [verb for _, verb, *_ in self.calls]

    async def call_async(self, robot: str, verb: str, arguments: Mapping[str, Any], within: float) -> Envelope:
        """Answer a call."""
        self.calls.append((robot, verb, dict(arguments), within))
        answer = self.given[verb]
        if isinstance(answer, Exception):
            raise answer
        return answer

    async def describe_async(self, robot: str, within: float) -> FoundRobot:
        """Describe the robot as the test says."""
        self.descriptions += 1
        if isinstance(self.described, Exception):
            raise self.described
        return FoundRobot(robot, functions=description() if self.described is None else self.described)

    async def stop_async(self, robot: str, within: float = STOP_S, robot_name: str = "") -> Envelope:
        """Count the stop; the last answer is given again and again."""
        self.stop_count += 1
        return self.stop_answers.pop(0) if len(self.stop_answers) > 1 else self.stop_answers[0]


def client_of(*networks: NetworkAdapter) -> Caller:
    opened = Networks(networks)
    opened.open()
    opened.settled()
    return Caller(opened)


@pytest.fixture(autouse=True)
def _soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "SETTLE_S", 0.01)
    monkeypatch.setattr(module, "POLL_S", 0.01)


LOST: list[RefusalError] = [
    UnreachableError("the connection is lost"),
    NoSuchRobotError("No device 'arm-1'."),
    NoAnswerError("arm-1 did not answer."),
]


@pytest.mark.parametrize("lost", LOST)
async def test_motion_that_is_out_of_sight_is_halted(lost: Exception) -> None:
    fleet = FakeNetwork(moveTo=RUNNING, wait=lost)
    answer = await client_of(fleet).move("arm-1", "moveTo", {"x": 0.1, "wait": True})
    assert is_error(answer) and "told to stop." in text_of(answer)
    assert fleet.stop_count == 1


@pytest.mark.parametrize("lost", LOST)
@pytest.mark.parametrize("name", [DEVICE_CONNECT, MESH])
async def test_policy_that_is_out_of_sight_is_halted(name: str, lost: Exception) -> None:
    fleet = FakeNetwork(name, getStatus=lost)
    fleet.given[fleet.starts] = success("under way")
    answer = await client_of(fleet).run_policy("arm-1", {}, wait=True)
    assert is_error(answer)
    assert fleet.stop_count == 1


async def test_robot_that_moved_to_the_other_network_meanwhile_gets_the_call_there() -> None:
    left, joined = FakeNetwork(execute=LOST[1]), FakeNetwork(MESH, start=success("under way"))
    client = client_of(left, joined)
    left.bears = lambda robot: not left.calls  # type: ignore[method-assign]
    joined.bears = lambda robot: bool(left.calls)  # type: ignore[method-assign]
    joined.reaches = joined.bears  # type: ignore[method-assign]
    assert not is_error(await client.call("arm-1", "execute", moves=True))
    assert (left.verbs, joined.verbs) == (["execute"], ["start"])


async def test_stop_of_a_lost_motion_is_repeated_until_it_is_confirmed() -> None:
    fleet = FakeNetwork(moveTo=RUNNING, wait=UnreachableError("the connection is lost"))
    fleet.stop_answers = [error("no link", stopped=None), success("Stopped.", stopped=True)]
    answer = await client_of(fleet).move("arm-1", "moveTo", {"x": 0.1, "wait": True})
    assert fleet.stop_count == 2
    assert "not confirmed" not in text_of(answer)


async def test_stop_that_is_not_confirmed_is_told() -> None:
    fleet = FakeNetwork(moveTo=RUNNING, wait=UnreachableError("the connection is lost"))
    fleet.stop_answers = [error("no link", stopped=None)]
    answer = await client_of(fleet).move("arm-1", "moveTo", {"x": 0.1, "wait": True})
    assert fleet.stop_count == module.STOPS_MAX
    assert "not confirmed: no link" in text_of(answer)


async def test_motion_that_ended_by_itself_is_not_stopped() -> None:
    fleet = FakeNetwork(moveTo=RUNNING, wait=success("there", task_status="completed"))
    assert not is_error(await client_of(fleet).move("arm-1", "moveTo", {"x": 0.1, "wait": True}))
    await asyncio.sleep(0)
    assert fleet.stop_count == 0


@pytest.mark.parametrize("refusal", [LockoutError("locked"), UnknownVerbError("no such verb"), LOST[0], LOST[1]])
async def test_motion_that_was_refused_is_not_stopped(refusal: RefusalError) -> None:
    fleet = FakeNetwork(moveTo=refusal)
    answer = await client_of(fleet).move("arm-1", "moveTo", {"x": 0.1, "wait": True})
    assert is_error(answer)
    assert refusal.why in text_of(answer)
    assert fleet.stop_count == 0


async def test_motion_that_may_have_begun_is_stopped() -> None:
    fleet = FakeNetwork(moveTo=NoAnswerError("arm-1 did not answer"))
    assert "told to stop" in text_of(await client_of(fleet).move("arm-1", "moveTo", {"x": 0.1, "wait": True}))
    assert fleet.stop_count == 1


async def test_motion_of_an_id_on_two_networks_goes_to_neither_and_its_stop_to_both() -> None:
    near, far = (FakeNetwork(name, getStatus=success("idle")) for name in (DEVICE_CONNECT, MESH))
    client = client_of(near, far)
    for answer in (
        await client.move("arm-1", "moveTo", {"x": 0.1, "wait": True}),
        await client.run_policy("arm-1", {}, wait=True),
        await client.acquire("arm-1", 60.0, ""),
    ):
        assert "device_connect and mesh both have" in text_of(answer)
    assert not {"moveTo", "execute", "start", "acquireControl"} & {*near.verbs, *far.verbs}
    far.stop_answers = [error("no brakes", stopped=False)]
    stopped = await client.stop("arm-1")
    assert (near.stop_count, far.stop_count) == (1, 1)
    assert stopped["stopped"] is False
    assert "arm-1 on mesh" in text_of(stopped)


async def test_stop_names_the_network_that_is_not_reached() -> None:
    near = FakeNetwork()
    near.unreachable = "no broker"
    with Networks([near], stays=True) as networks:
        client = Caller(networks)
        for answer in (await client.stop("arm-1"), await client.stop(""), await client.emergency_stop("test")):
            assert is_error(answer), answer
            assert answer["stopped"] is not True
            assert "no broker" in text_of(answer)


@pytest.mark.parametrize(
    "published, bound",
    [
        (description("x", "lease_id", "lease_ttl_s"), True),
        (description("x", "lease_id"), False),
        (description("x"), False),
        ((), False),
        ([{"name": "moveTo", "parameters": ["lease_ttl_s"]}], False),
        (NoAnswerError("arm-1 did not answer."), True),
    ],
)
@pytest.mark.parametrize("name", [DEVICE_CONNECT, MESH])
async def test_motion_carries_a_lease_only_to_a_robot_that_publishes_it(
    name: str, published: object, bound: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "SILENCE_S", 0.0)
    fleet = FakeNetwork(name, moveTo=RUNNING, getStatus=success("idle"), renewControl=success(""))
    fleet.given |= {"wait": success("there", task_status="completed"), fleet.starts: RUNNING}
    fleet.described = published
    client = client_of(fleet)
    assert not is_error(await client.move("arm-1", "moveTo", {"x": 0.1, "wait": True}))
    assert not is_error(await client.run_policy("arm-1", {"instruction": "wave"}, wait=True))
    for verb in ("moveTo", fleet.starts):
        assert [each in fleet.sent(verb) for each in ("lease_id", "lease_ttl_s")] == [bound, bound]
    assert bound == ("renewControl" in fleet.verbs)
    assert fleet.descriptions == 2


async def test_robot_is_asked_once_whether_it_takes_the_lease_of_a_motion() -> None:
    fleet = FakeNetwork(moveTo=success("", task_status="completed"))
    fleet.described = description("lease_ttl_s")
    client = client_of(fleet)
    for _ in range(3):
        await client.move("arm-1", "moveTo", {"x": 0.1, "wait": True})
    assert fleet.descriptions == 1


async def test_held_lease_goes_to_any_robot_that_gave_it() -> None:
    fleet = FakeNetwork(
        acquireControl=success("", lease_id="a" * 32), getStatus=success("idle"), renewControl=success("")
    )
    fleet.given["moveTo"] = success("", task_status="completed")
    fleet.described = description("x")
    client = client_of(fleet)
    assert not is_error(await client.acquire("arm-1", 60.0, ""))
    assert "lease_id" not in fleet.sent("acquireControl")
    await client.move("arm-1", "moveTo", {"x": 0.1, "wait": True})
    assert fleet.sent("moveTo")["lease_id"] == "a" * 32
    assert "lease_ttl_s" not in fleet.sent("moveTo")
    client._forget(("arm-1", ""))


async def test_client_that_moves_a_robot_acquires_it_by_the_secret_of_its_motion() -> None:
    fleet = FakeNetwork(moveTo=RUNNING, getStatus=success("idle"), acquireControl=error("held"))
    asked = asyncio.Event()
    go_on = asyncio.Event()
    answer = fleet.call_async

    async def waits(robot: str, verb: str, params: Mapping[str, Any], within: float) -> Envelope:
        if verb == "wait":
            asked.set()
            await go_on.wait()
            return success("there", task_status="completed")
        return await answer(robot, verb, params, within)

    fleet.call_async = waits  # type: ignore[method-assign]
    fleet.described = description("lease_id", "lease_ttl_s")
    client = client_of(fleet)
    motion = asyncio.ensure_future(client.move("arm-1", "moveTo", {"x": 0.1, "wait": True}))
    await asyncio.wait_for(asked.wait(), 20.0)
    await client.acquire("arm-1", 60.0, "")
    assert fleet.sent("acquireControl")["lease_id"] == fleet.sent("moveTo")["lease_id"]
    go_on.set()
    assert not is_error(await motion)


def own_verb(name: str = "brewCoffee", *leases: str, **more: Any) -> AdvertisedVerb:
    properties = {each: {"type": "string"} for each in ("cups", *leases)}
    labels = {"direction": "write", "own": "true", "lasts_s": "90"}
    found = find_verb([{"name": name, "parameters": {"properties": properties}, "labels": labels, **more}], name)
    assert found is not None
    return found


@pytest.mark.parametrize("leases", [("lease_id", "lease_ttl_s"), ()])
async def test_own_verb_carries_the_lease_that_it_takes_and_is_waited_for(
    leases: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    fleet, waits = FakeNetwork(brewCoffee=success("brewed")), list[float]()
    call = fleet.call_async

    async def timed(robot: str, verb: str, params: Mapping[str, Any], within: float) -> Envelope:
        waits.append(within)
        return await call(robot, verb, params, within)

    monkeypatch.setattr(fleet, "call_async", timed)
    answer = await client_of(fleet).act("bar-1", own_verb("brewCoffee", *leases), {"cups": 2})
    assert text_of(answer) == "brewed"
    assert set(fleet.sent("brewCoffee")) == {"cups", *leases}
    assert waits == [100.0]
    assert fleet.stop_count == 0


async def test_held_lease_goes_with_no_verb_that_does_not_take_it() -> None:
    fleet = FakeNetwork(
        brewCoffee=success("brewed"),
        acquireControl=success("held", lease_id="secret", robot_name=""),
        getStatus=success("idle"),
        renewControl=success("renewed"),
    )
    client = client_of(fleet)
    await client.acquire("bar-1", 60.0, "")
    await client.act("bar-1", own_verb(), {})
    assert fleet.sent("brewCoffee") == {}
    await client.act("bar-1", own_verb("brewCoffee", "lease_id"), {})
    assert fleet.sent("brewCoffee") == {"lease_id": "secret"}


async def test_motion_that_goes_on_after_its_answer_is_followed_to_its_end() -> None:
    fleet = FakeNetwork(brewCoffee=RUNNING, getStatus=success("over", task_status="completed"))
    answer = await client_of(fleet).act("bar-1", own_verb("brewCoffee", "lease_id"), {})
    assert text_of(answer) == "under way"
    assert fleet.verbs == ["brewCoffee", "getStatus"]


async def test_own_verb_whose_call_is_cancelled_is_halted(monkeypatch: pytest.MonkeyPatch) -> None:
    fleet, begun = FakeNetwork(), asyncio.Event()

    async def hangs(robot: str, verb: str, params: Mapping[str, Any], within: float) -> Envelope:
        begun.set()
        await asyncio.Event().wait()
        raise AssertionError

    monkeypatch.setattr(fleet, "call_async", hangs)
    acting = asyncio.ensure_future(client_of(fleet).act("bar-1", own_verb(), {"robot_name": ["no name"]}))
    await begun.wait()
    acting.cancel()
    await asyncio.wait([acting])
    assert fleet.stop_count >= 1
