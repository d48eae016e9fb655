"""The framework is the pinned one, and our runtime answers commands as its own does."""

import asyncio
import hashlib
import importlib.metadata
import inspect
import json
import logging
import threading

import pytest
from device_connect_edge import DeviceRuntime
from device_connect_edge.discovery import PresenceAnnouncer
from device_connect_edge.drivers import DeviceDriver, before_emit, decorators, on, periodic, rpc
from device_connect_edge.drivers.decorators import get_rpc_source_device
from opentelemetry import trace
from opentelemetry.sdk.trace import TracerProvider

from strands_robots.device_connect._compat import CollectedOnce, Runtime
from strands_robots.device_connect.backends import LinkConfig, jsonrpc


class Driver(DeviceDriver):
    device_type = "toy"

    @rpc()
    async def whoAsks(self, value: str = "") -> dict:
        """Return the value and the caller.

        Args:
            value: given back
        """
        return {"value": value, "caller": get_rpc_source_device()}

    @rpc(name="renamed")
    async def other(self) -> str:
        """Have another name on the wire."""
        return "renamed"

    @rpc()
    async def fail(self) -> dict:
        """Fail."""
        raise ValueError("the arm is off")

    @rpc()
    async def partly(self) -> dict:
        """Tell of an error."""
        return {"error": "half of it"}

    @rpc()
    async def opaque(self) -> object:
        """Give what has no JSON."""
        return object()

    @rpc()
    async def late(self) -> str | None:
        """Return the caller, after a while."""
        await asyncio.sleep(0.01)
        return get_rpc_source_device()


class Choosy(Driver):
    async def invoke(self, function_name, /, **params):
        if "value" in params:
            return f"{function_name} refused"
        return await super().invoke(function_name, **params)


class Messaging:
    """A client stand-in that hands commands to the runtime and keeps its answer."""

    def __init__(self):
        self.serve_command = None
        self.serving = None
        self.answer = None

    async def serve(self, _subject, serve):
        def answered(data):
            self.answer = data

        self.serve_command, self.serving = serve, lambda data: serve(jsonrpc.check(data), answered)

    async def subscribe(self, _subject, callback):
        self.serving = lambda data: callback(data, "reply")

    async def publish(self, _subject, data):
        self.answer = data

    async def ask(self, data):
        self.answer = None
        await self.serving(data)
        return json.loads(self.answer)


async def served(runtime):
    runtime.messaging = Messaging()
    runtime._driver.set_device(runtime)
    await runtime._cmd_subscription()
    return runtime.messaging


def ours(driver):
    return Runtime(driver=driver, device_id="toy-1", link=LinkConfig(), allow_insecure=True)


def stock(driver):
    return DeviceRuntime(driver=driver, device_id="toy-1", messaging_urls=["zenoh://"], allow_insecure=True)


COMMANDS = {
    "a call": ("whoAsks", {"value": "x"}),
    "a named caller": ("whoAsks", {"_dc_meta": {"source_device": "agent-1", "traceparent": "00-1-2-03"}}),
    "a caller named among the parameters": ("whoAsks", {"source_device": "agent-2"}),
    "both": ("whoAsks", {"source_device": "agent-2", "_dc_meta": {"source_device": "agent-1"}}),
    "an empty caller": ("whoAsks", {"_dc_meta": {"source_device": ""}}),
    "a caller that still counts after a wait": ("late", {"_dc_meta": {"source_device": "agent-1"}}),
    "another name": ("renamed", {}),
    "a method's own name that is not its name": ("other", {}),
    "unknown": ("nope", {}),
    "private": ("_collect_functions", {}),
    "a failure": ("fail", {}),
    "a partial failure": ("partly", {}),
    "no JSON": ("opaque", {}),
    "a parameter too many": ("whoAsks", {"nope": 1}),
    "registration": ("requestRegistration", {}),
}


@pytest.mark.parametrize("kind", [Driver, Choosy])
@pytest.mark.parametrize("what", COMMANDS)
async def test_command_gets_the_frameworks_own_answer(what, kind):
    method, params = COMMANDS[what]
    data = json.dumps({"jsonrpc": "2.0", "id": "c-1", "method": method, "params": params}).encode()
    mine, theirs = await served(ours(kind())), await served(stock(kind()))
    answer, expected = await mine.ask(data), await theirs.ask(data)
    if method == "opaque":
        assert "not JSON serializable" in answer["error"]["message"]
    elif method == "requestRegistration":
        assert answer["result"].keys() == expected["result"].keys()
        return
    assert answer == expected
    assert get_rpc_source_device() is None


async def test_concurrent_calls_keep_their_callers_apart():
    messaging = await served(ours(Driver()))
    answers = []

    async def ask(number):
        command = jsonrpc.RpcRequest("late", number, {"_dc_meta": {"source_device": f"agent-{number}"}})
        await messaging.serve_command(command, lambda data: answers.append(json.loads(data)))

    await asyncio.gather(*(ask(number) for number in range(20)))
    assert all(each["result"] == f"agent-{each['id']}" for each in answers)


@pytest.mark.parametrize(("method", "line"), [("fail", "the arm is off"), ("partly", "half of it")])
async def test_failures_are_logged(method, line, caplog):
    messaging = await served(ours(Driver()))
    with caplog.at_level(logging.WARNING, decorators.logger.name):
        await messaging.ask(json.dumps({"id": 1, "method": method}).encode())
    assert line in caplog.text


async def test_calls_are_logged_at_info_level(caplog):
    messaging = await served(ours(Driver()))
    with caplog.at_level(logging.INFO, decorators.logger.name):
        await messaging.ask(json.dumps({"id": 1, "method": "whoAsks"}).encode())
    assert ">>> RPC EXEC" in caplog.text


async def test_framework_serves_when_a_tracer_is_configured(monkeypatch):
    monkeypatch.setattr(trace, "get_tracer_provider", TracerProvider)
    driver = Driver()
    messaging = await served(ours(driver))
    assert (await messaging.ask(b'{"id": 1, "method": "whoAsks"}'))["result"]["value"] == ""
    assert messaging.serve_command is None
    assert driver._get_functions()["whoAsks"] == driver.whoAsks


def test_presence_is_the_frameworks_own_message():
    def announced(runtime):
        runtime.messaging = None
        capabilities = runtime._driver.capabilities.model_dump()
        runtime._d2d_announcer = PresenceAnnouncer(
            None, "toy-1", "default", capabilities, {"model": "x"}, runtime.status
        )
        message = json.loads(runtime._d2d_announcer._build_payload())
        for each in (message, message["status"]):
            del each["ts"]
        return message

    mine, theirs = ours(Driver()), stock(Driver())
    mine.status = theirs.status = {"availability": "busy"}
    assert announced(mine) == announced(theirs)
    # The status is read anew for each message.
    mine.status["availability"] = "idle"
    assert json.loads(mine._d2d_announcer._build_payload())["status"]["availability"] == "idle"


class Marked(CollectedOnce, Driver):
    @on(event_name="peer_lost")
    async def _on_lost(self, device_id, event_name, payload):
        """Note."""

    @periodic(interval=60.0)
    async def tick(self):
        """Tick."""

    @before_emit("done")
    async def first(self, payload, **_more):
        """Go first."""


def test_methods_collected_once_are_those_that_the_framework_finds():
    class Plain(Driver):
        _on_lost, tick, first = Marked._on_lost, Marked.tick, Marked.first

    def collected(driver):
        driver._collect_routines()
        driver._collect_internal_handlers()
        handlers = {name: [each.__name__ for each in found] for name, found in driver._internal_handlers.items()}
        subscriptions = [each["handler"].__name__ for each in driver._collect_event_subscriptions()]
        return sorted(driver._get_functions()), sorted(driver._routines), handlers, subscriptions

    assert collected(Marked()) == collected(Plain())
    assert collected(Marked())[1:] == (["tick"], {"done": ["first"]}, ["_on_lost"])
    assert "invoke" in dir(Marked())


class Meeting(Marked):
    """A driver whose methods are looked for by another thread while they are looked for."""

    met = False

    def __getattribute__(self, name):
        if name == "first" and not self.met:
            self.met = True
            other = threading.Thread(target=self._collect_routines)
            other.start()
            other.join(20)
        return super().__getattribute__(name)


def test_two_threads_look_for_the_methods_of_a_driver_at_once():
    driver = Meeting()
    driver._collect_internal_handlers()
    assert driver.met
    assert [each.__name__ for each in driver._internal_handlers["done"]] == ["first"]
    assert sorted(driver._routines) == ["tick"]


# Members that _compat.py calls, replaces, or whose way of working it relies upon.
SOURCE_HASHES = {
    "DeviceDriver._collect_event_subscriptions": "e7cb8dcf80dd5e57",
    "DeviceDriver._collect_internal_handlers": "8e6ddae73ead5f0b",
    "DeviceDriver._collect_routines": "dc71c15bf180514e",
    "PresenceAnnouncer.__init__": "d44d12623ab47859",
    "PresenceAnnouncer._build_payload": "ee9a1f6416aa0fbf",
    "DeviceDriver._get_functions": "7dc82c18974d7295",
    "DeviceDriver._invoke_decorated": "2edf78c79ad0cb8d",
    "DeviceDriver.invoke": "275902836c43f991",
    "DeviceRuntime.__init__": "df4dbaf9278fcd85",
    "DeviceRuntime._build_registration_params": "da0e9a8d64b409de",
    "DeviceRuntime._cmd_subscription": "8b7c088c5623da36",
    "DeviceRuntime._connect_messaging": "2b6523fb05815087",
    "DeviceRuntime._event_dispatch_loop": "6502b78a542fcf6a",
    "DeviceRuntime._heartbeat_loop": "966ef1a01aecda52",
    "DeviceRuntime._notify_conn_state": "81238ddf7da961b3",
    "DeviceRuntime._register": "d157bbac0df5ea4d",
    "DeviceRuntime._resubscribe_after_reconnect": "66a353dea257fe50",
    "DeviceRuntime._track_task": "37e65a174cde4a05",
    "DeviceRuntime._warn_if_predicate_extra_missing": "0af1317091150b22",
    "DeviceRuntime._validate_startup_config": "5b239cd646cf984c",
    "DeviceRuntime.enqueue_event": "40b84ccb6d07b492",
    "DeviceRuntime.run": "a2472bb8763ce3c6",
    "DeviceRuntime.stop": "e2d84df25977a1c9",
    "decorators.rpc": "4c6b571e695dcfd9",
}


OWNERS = {
    "DeviceRuntime": DeviceRuntime,
    "DeviceDriver": DeviceDriver,
    "PresenceAnnouncer": PresenceAnnouncer,
    "decorators": decorators,
}


def test_framework_has_the_pinned_version():
    assert importlib.metadata.version("device-connect-edge") == "0.2.5"


@pytest.mark.parametrize("name", SOURCE_HASHES)
def test_framework_member_has_not_changed(name):
    owner, _, member = name.partition(".")
    source = inspect.getsource(getattr(OWNERS[owner], member))
    found = hashlib.sha256(source.encode()).hexdigest()[:16]
    assert found == SOURCE_HASHES[name], f"read {name} again before trusting _compat.py"
