"""Motions of one MCP client, and what halts them."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from typing import Any

import pytest
from device_connect_edge.messaging import MessagingError

from strands_robots.device_connect.client import DeviceTimeoutError, NoSuchDeviceError
from strands_robots.envelope import Envelope, error, is_error, success, text_of
from strands_robots.mcp import caller as module
from strands_robots.mcp.caller import Caller
from strands_robots.serving.advertised import AdvertisedVerb, find_verb

RUNNING = success("under way", task_id="moveTo-1", task_status="running")


class FakeFleet:
    """A connection that gives the answers, or raises the errors, that a test sets."""

    def __init__(self, **answers: Envelope | Exception) -> None:
        self.answers = answers
        self.stop_answers = [success("Stopped.", stopped=True)]
        self.stops = 0
        self.calls: list[tuple[str, dict[str, Any]]] = []

    def sent(self, verb: str) -> dict[str, Any]:
        """Return the parameters of the last call of a verb."""
        return next(params for name, params in reversed(self.calls) if name == verb)

    async def call_async(self, robot: str, verb: str, params: Mapping[str, Any], within: float) -> Envelope:
        """Answer a call."""
        self.calls.append((verb, dict(params)))
        answer = description() if verb == "requestRegistration" and verb not in self.answers else self.answers[verb]
        if isinstance(answer, Exception):
            raise answer
        return answer

    async def stop_async(self, robot: str, within: float = 5.0, robot_name: str = "") -> Envelope:
        """Count the stop; the last answer is given again and again."""
        self.stops += 1
        return self.stop_answers.pop(0) if len(self.stop_answers) > 1 else self.stop_answers[0]


def description(*parameters: str) -> Envelope:
    """Return the description of a robot whose verbs have these parameters."""
    properties = {name: {"type": "string", "description": "As lease_ttl_s."} for name in parameters}
    schema = {"type": "object", "properties": properties}
    functions = [{"name": verb, "parameters": schema} for verb in ("moveTo", "execute")]
    return {"device_id": "arm-1", "status": {}, "capabilities": {"functions": functions}}


def client_of(fleet: FakeFleet) -> Caller:
    connection: Any = fleet
    return Caller(connection)


@pytest.fixture(autouse=True)
def _soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "SETTLE_S", 0.01)
    monkeypatch.setattr(module, "POLL_S", 0.01)


LOST = [
    MessagingError("the connection is lost"),
    NoSuchDeviceError("No device 'arm-1'."),
    DeviceTimeoutError("arm-1 did not answer."),
]


@pytest.mark.parametrize("lost", LOST)
async def test_motion_that_is_out_of_sight_is_halted(lost: Exception) -> None:
    fleet = FakeFleet(moveTo=RUNNING, wait=lost)
    answer = await client_of(fleet).move("arm-1", "moveTo", {"x": 0.1}, wait=True)
    assert is_error(answer) and "told to stop." in text_of(answer)
    assert fleet.stops == 1


@pytest.mark.parametrize("lost", LOST)
async def test_policy_that_is_out_of_sight_is_halted(lost: Exception) -> None:
    fleet = FakeFleet(execute=success("under way"), getStatus=lost)
    answer = await client_of(fleet).run_policy("arm-1", {}, wait=True)
    assert is_error(answer)
    assert fleet.stops == 1


async def test_stop_of_a_lost_motion_is_repeated_until_it_is_confirmed() -> None:
    fleet = FakeFleet(moveTo=RUNNING, wait=MessagingError("the connection is lost"))
    fleet.stop_answers = [error("no link", stopped=None), success("Stopped.", stopped=True)]
    answer = await client_of(fleet).move("arm-1", "moveTo", {"x": 0.1}, wait=True)
    assert fleet.stops == 2
    assert "not confirmed" not in text_of(answer)


async def test_stop_that_is_not_confirmed_is_told() -> None:
    fleet = FakeFleet(moveTo=RUNNING, wait=MessagingError("the connection is lost"))
    fleet.stop_answers = [error("no link", stopped=None)]
    answer = await client_of(fleet).move("arm-1", "moveTo", {"x": 0.1}, wait=True)
    assert fleet.stops == module.STOPS_MAX
    assert "not confirmed: no link" in text_of(answer)


async def test_motion_that_ended_by_itself_is_not_stopped() -> None:
    fleet = FakeFleet(moveTo=RUNNING, wait=success("there", task_status="completed"))
    assert not is_error(await client_of(fleet).move("arm-1", "moveTo", {"x": 0.1}, wait=True))
    await asyncio.sleep(0)
    assert fleet.stops == 0


@pytest.mark.parametrize(
    "published, bound",
    [
        (description("x", "lease_id", "lease_ttl_s"), True),
        (description("x", "lease_id"), False),
        (description("x"), False),
        ({"device_id": "arm-1"}, False),
        ({"capabilities": {"functions": [{"name": "moveTo", "parameters": ["lease_ttl_s"]}]}}, False),
        (DeviceTimeoutError("arm-1 did not answer."), True),
    ],
)
async def test_motion_carries_a_lease_only_to_a_robot_that_publishes_it(
    published: Envelope | Exception, bound: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "SILENCE_S", 0.0)
    fleet = FakeFleet(
        requestRegistration=published,
        moveTo=RUNNING,
        execute=RUNNING,
        getStatus=success("idle"),
        renewControl=success(""),
    )
    fleet.answers["wait"] = success("there", task_status="completed")
    client = client_of(fleet)
    assert not is_error(await client.move("arm-1", "moveTo", {"x": 0.1}, wait=True))
    assert not is_error(await client.run_policy("arm-1", {"instruction": "wave"}, wait=True))
    for verb in ("moveTo", "execute"):
        assert [name in fleet.sent(verb) for name in ("lease_id", "lease_ttl_s")] == [bound, bound]
    assert bound == any(verb == "renewControl" for verb, _ in fleet.calls)
    assert sum(verb == "requestRegistration" for verb, _ in fleet.calls) == 2


async def test_robot_is_asked_once_whether_it_takes_the_lease_of_a_motion() -> None:
    fleet = FakeFleet(requestRegistration=description("lease_ttl_s"), moveTo=success("", task_status="completed"))
    client = client_of(fleet)
    for _ in range(3):
        await client.move("arm-1", "moveTo", {"x": 0.1}, wait=True)
    assert sum(verb == "requestRegistration" for verb, _ in fleet.calls) == 1


async def test_held_lease_goes_to_any_robot_that_gave_it() -> None:
    fleet = FakeFleet(
        acquireControl=success("", lease_id="a" * 32), getStatus=success("idle"), renewControl=success("")
    )
    fleet.answers |= {"moveTo": success("", task_status="completed"), "requestRegistration": description("x")}
    client = client_of(fleet)
    assert not is_error(await client.acquire("arm-1", 60.0, ""))
    assert "lease_id" not in fleet.sent("acquireControl")
    await client.move("arm-1", "moveTo", {"x": 0.1}, wait=True)
    assert fleet.sent("moveTo")["lease_id"] == "a" * 32
    assert "lease_ttl_s" not in fleet.sent("moveTo")
    client._forget(("arm-1", ""))


async def test_client_that_moves_a_robot_acquires_it_by_the_secret_of_its_motion() -> None:
    fleet = FakeFleet(moveTo=RUNNING, getStatus=success("idle"), acquireControl=error("held"))
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
    fleet.answers["requestRegistration"] = description("lease_id", "lease_ttl_s")
    client = client_of(fleet)
    motion = asyncio.ensure_future(client.move("arm-1", "moveTo", {"x": 0.1}, wait=True))
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
    fleet, waits = FakeFleet(brewCoffee=success("brewed")), list[float]()
    call = fleet.call_async

    async def timed(robot: str, verb: str, params: Mapping[str, Any], within: float) -> Envelope:
        waits.append(within)
        return await call(robot, verb, params, within)

    monkeypatch.setattr(fleet, "call_async", timed)
    answer = await client_of(fleet).act("bar-1", own_verb("brewCoffee", *leases), {"cups": 2})
    assert text_of(answer) == "brewed"
    assert set(fleet.sent("brewCoffee")) == {"cups", *leases}
    assert waits == [100.0]
    assert fleet.stops == 0


async def test_held_lease_goes_with_no_verb_that_does_not_take_it() -> None:
    fleet = FakeFleet(
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
    fleet = FakeFleet(brewCoffee=RUNNING, getStatus=success("over", task_status="completed"))
    answer = await client_of(fleet).act("bar-1", own_verb("brewCoffee", "lease_id"), {})
    assert text_of(answer) == "under way"
    assert [verb for verb, _ in fleet.calls] == ["brewCoffee", "getStatus"]


async def test_own_verb_whose_call_is_cancelled_is_halted(monkeypatch: pytest.MonkeyPatch) -> None:
    fleet, begun = FakeFleet(), asyncio.Event()

    async def hangs(robot: str, verb: str, params: Mapping[str, Any], within: float) -> Envelope:
        begun.set()
        await asyncio.Event().wait()
        raise AssertionError

    monkeypatch.setattr(fleet, "call_async", hangs)
    acting = asyncio.ensure_future(client_of(fleet).act("bar-1", own_verb(), {"robot_name": ["no name"]}))
    await begun.wait()
    acting.cancel()
    await asyncio.wait([acting])
    assert fleet.stops >= 1
