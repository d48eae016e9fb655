"""Calls, stops and questions on Device Connect from an event loop."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest
from device_connect_edge.messaging import MessagingError

from strands_robots import errors
from strands_robots.device_connect import client as clients
from strands_robots.device_connect.backends import loopback_config
from strands_robots.device_connect.discovery import Peer
from strands_robots.envelope import success
from strands_robots.fleet.adapter import CLOSED
from strands_robots.fleet.device_connect import stops
from strands_robots.fleet.device_connect.network import DeviceConnectNetwork
from strands_robots.safety.identity import KeyFileError
from strands_robots.serving.advertised import AdvertisedVerb, find_verb
from strands_robots.utils import ValidationError


class Client(clients.FleetClient):
    """A client without a connection whose answer a test sets."""

    answer: Any = None

    async def call_async(self, device: str, function: str, params: Any = None, within: float = 10.0) -> dict[str, Any]:
        if isinstance(self.answer, Exception):
            raise self.answer
        return dict(self.answer)

    async def stop_async(self, device: str, within: float = 5.0, robot_name: str = "") -> dict[str, Any]:
        return await self.call_async(device, "stop")

    functions: tuple[dict[str, Any], ...] = ()

    def verb(self, device: str, name: str) -> AdvertisedVerb | None:
        return find_verb(self.functions, name)

    def call(self, device: str, function: str, params: Any = None, timeout: float = 10.0) -> dict[str, Any]:
        return success(function)

    def announces(self, device: str, function: str, argument: str) -> bool:
        return False


@pytest.fixture
def there() -> Any:
    client = Client(loopback_config(1))
    yield DeviceConnectNetwork.joined(client)
    client.close()


FAILURES: tuple[tuple[Exception, type[errors.RefusalError]], ...] = (
    (clients.NoSuchDeviceError("no device 'arm-1'"), errors.NoSuchRobotError),
    (clients.DeviceTimeoutError("arm-1 did not answer"), errors.NoAnswerError),
    (clients.ClientClosedError(CLOSED), errors.NoAnswerError),
    (clients.CallRefusedError("\x1b[2Jbusy", -32000), errors.RobotError),
    (ValidationError("x must be a number"), errors.ArgumentsError),
    (MessagingError("the broker is gone"), errors.UnreachableError),
)


@pytest.mark.parametrize("failure, refusal", FAILURES, ids=lambda each: getattr(each, "__name__", ""))
def test_failure_is_a_refusal_a_verdict_and_a_problem(
    there: Any, failure: Exception, refusal: type[errors.RefusalError]
) -> None:
    there._client.answer = failure

    async def asked() -> Any:
        with pytest.raises(refusal) as refused:
            await there.call_async("arm-1", "moveTo", {}, 1.0)
        with pytest.raises(refusal):
            await there.describe_async("arm-1", 1.0)
        return refused.value, await there.stop_async("arm-1", 1.0), await there.lockout_async("arm-1", 1.0)

    refused, stopped, report = asyncio.run(asked())
    said = str(failure).replace("\x1b[2J", "")
    assert [refused.why, stopped["content"][0]["text"], report.problem] == [said] * 3
    assert (stopped["stopped"], dict(report.facts)) == (None, {})


def test_device_is_described_under_the_id_that_it_was_asked_by(there: Any) -> None:
    functions = [{"name": "moveTo"}]
    there._client.answer = {"device_id": "arm-9", "capabilities": {"functions": functions}}
    found = asyncio.run(there.describe_async("arm-1", 1.0))
    assert (found.id, list(found.functions)) == ("arm-1", functions)


def test_device_that_is_gone_is_forgotten(there: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(there._client, "peers", lambda timeout: [Peer("arm-1")])
    monkeypatch.setattr(there._client, "known", tuple)
    there.find()
    assert there.bears("arm-1")
    there._client.answer = clients.NoSuchDeviceError("no device 'arm-1'")
    with pytest.raises(errors.NoSuchRobotError):
        asyncio.run(there.call_async("arm-1", "getStatus", {}, 1.0))
    assert not there.bears("arm-1")


@pytest.mark.parametrize(
    ("verb", "functions", "called"),
    [
        ("status", ("getStatus",), "getStatus"),
        ("state", ("getState",), "getState"),
        ("features", (), "getFeatures"),
        ("start", ("execute",), "execute"),
        ("getStatus", ("getStatus",), "getStatus"),
        # A device that is not ours may have a function of that name.
        ("status", ("status", "getStatus"), "status"),
        ("start", ("start",), "start"),
        ("spin", ("start",), "spin"),
    ],
)
def test_verb_is_called_by_its_name_on_the_mesh_unless_the_device_has_that_function(
    there: Any, verb: str, functions: tuple[str, ...], called: str
) -> None:
    there._client.functions = tuple({"name": each} for each in functions)
    assert there.call("arm-1", verb, {}, 1.0)["content"][0]["text"] == called
    described = there.verb("arm-1", verb)
    assert (None if described is None else described.name) == (called if called in functions else None)


def test_end_of_the_events_of_a_lost_connection_does_not_fail(there: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []

    class Lost:
        def close(self) -> None:
            asked.append("close")
            raise MessagingError("the broker is gone")

    monkeypatch.setattr(there._client, "subscription", lambda device, callback: Lost())
    there.subscribe("*", asked.append)()
    assert asked == ["close"]


def test_lockouts_count_only_while_the_enrolled_keys_can_be_used(there: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    there._client.answer = success("idle", locked=False, lockout=[])
    assert asyncio.run(there.lockout_async("arm-1", 1.0)).problem == ""

    def unusable(link: Any) -> Any:
        raise KeyFileError("open to others")

    monkeypatch.setattr(stops, "enrolled_keys", unusable)
    other = DeviceConnectNetwork.joined(there._client)
    report = asyncio.run(other.lockout_async("arm-1", 1.0))
    assert report.problem == stops.KEYS_UNUSABLE
    assert report.facts["locked"] is False
