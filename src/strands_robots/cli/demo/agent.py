"""The demo's agent: an unmodified client, the framework's own agent tools over one loopback endpoint."""

from __future__ import annotations

import re
import time
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from strands_robots import settings
from strands_robots.cli.output import Failure
from strands_robots.utils import missing_extra

TENANT = "demo"

_SEPARATOR = re.compile(r"[./]")
_POLL_S = 0.02


@dataclass(frozen=True, slots=True)
class Event:
    """One event of a device: its name, what it carries, and when it arrived (monotonic seconds)."""

    name: str
    payload: Mapping[str, Any]
    at: float = field(default_factory=time.monotonic)


class Agent:
    """What an agent does, in the words of ``device_connect_agent_tools``."""

    def __init__(self, tools: Any, endpoint: str) -> None:
        self._tools = tools
        self.endpoint = endpoint

    def discover(self, device_id: str, within: float = 8.0) -> dict[str, Any]:
        """The device as discovery describes it.

        Raises:
            Failure: it does not appear within ``within`` seconds.
        """
        deadline = time.monotonic() + within
        while time.monotonic() < deadline:
            for device in self._quiet("discover_devices", refresh=True):
                if device.get("device_id") == device_id:
                    found: dict[str, Any] = device
                    return found
            time.sleep(_POLL_S * 5)
        raise Failure(f"{device_id} was not discovered within {within:g} s.")

    def call(self, device_id: str, function: str, **params: Any) -> dict[str, Any]:
        """Call a function and return its envelope.

        Raises:
            Failure: no answer, an error of the framework, or an envelope that says error.
        """
        result = self.ask(device_id, function, **params)
        if result.get("status") == "error":
            raise Failure(f"{function} was refused: {result.get('reason')}")
        return result

    def ask(self, device_id: str, function: str, **params: Any) -> dict[str, Any]:
        """The same, where a refusal is an answer.

        Raises:
            Failure: no answer, or an error of the framework.
        """
        answer = self._quiet("invoke_device", device_id, function, params)
        if not answer.get("success"):
            raise Failure(f"{function} was not answered: {answer.get('error')}")
        result = answer.get("result")
        if not isinstance(result, dict):
            raise Failure(f"{function} answered with {type(result).__name__}, not with an envelope.")
        return result

    @contextmanager
    def events(self, device_id: str) -> Iterator[Stream]:
        """Every event of a device from now on."""
        with self._tools.subscribe(f"device({device_id}).event(*)") as subscription:
            yield Stream(subscription)

    def _quiet(self, tool: str, *args: Any, **kwargs: Any) -> Any:
        with warnings.catch_warnings():
            # The two best known tools are announced to be renamed; they are what agents in the field use.
            warnings.simplefilter("ignore", DeprecationWarning)
            return getattr(self._tools, tool)(*args, **kwargs)


class Stream:
    """Events as they arrive."""

    def __init__(self, subscription: Any) -> None:
        self._subscription = subscription

    def read(self) -> list[Event]:
        """What arrived since the last call."""
        arrived = []
        for message in self._subscription.read():
            name = _SEPARATOR.split(str(message.get("_subject", "")))[-1]
            params = message.get("params")
            payload = params if isinstance(params, Mapping) else message
            arrived.append(Event(name, payload))
        return arrived

    def follow(self, seconds: float) -> Iterator[Event]:
        """Events for ``seconds``, as they arrive."""
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            yield from self.read()
            time.sleep(_POLL_S)
        yield from self.read()


@contextmanager
def connected(port: int) -> Iterator[Agent]:
    """The agent on the loopback endpoint at ``port``, whatever the user's own environment says.

    Raises:
        Failure: nothing accepts it there.
        MissingExtraError: the agent tools are not installed.
    """
    try:
        import device_connect_agent_tools as tools  # noqa: PLC0415 - loaded when the demo runs
    except ModuleNotFoundError as exc:
        raise missing_extra("the demo", "device-connect") from exc
    for name in ("MESSAGING_CREDENTIALS_FILE", "NATS_CREDENTIALS_FILE", "ZENOH_LISTEN"):
        settings.put(name, "")
    for part in ("CA", "CERT", "KEY"):
        settings.put(f"MESSAGING_TLS_{part}_FILE", "")
    settings.put("MESSAGING_BACKEND", "zenoh")
    settings.put("DEVICE_CONNECT_DISCOVERY_MODE", "d2d")
    endpoint = f"tcp/127.0.0.1:{port}"
    try:
        tools.connect(nats_url=endpoint, zone=TENANT, request_timeout=10.0)
    except Exception as exc:
        raise Failure(f"The agent could not connect to {endpoint}: {exc}") from exc
    try:
        yield Agent(tools, endpoint)
    finally:
        tools.disconnect()
