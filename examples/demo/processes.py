"""Processes of the demo: the robot, and the agent with the framework's tools."""

from __future__ import annotations

import contextlib
import json
import queue
import re
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import IO, Any

from strands_robots import settings
from strands_robots.cli.output import CliError, Exit
from strands_robots.utils import missing_extra

TENANT = "demo"

READY_S = 20.0
"""Seconds until the robot has to be on the network; the first start compiles the installation's bytecode."""

DEPART_S = 6.0
"""Seconds the process has to stop its motion and depart, before it is killed."""

_SEPARATOR = re.compile(r"[./]")
_POLL_S = 0.02


class RobotProcess:
    """A running ``strands-robots serve``."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self.process = process
        self._lines: queue.Queue[str] = queue.Queue()
        self._complaints: list[str] = []
        # They read to the end: a full pipe would hold the robot up.
        readers = ((process.stdout, self._lines.put), (process.stderr, self._complaints.append))
        self._readers = [threading.Thread(target=_read_lines, args=each, daemon=True) for each in readers]
        for reader in self._readers:
            reader.start()

    def check(self) -> None:
        """Raise :class:`CliError` when the process has ended."""
        code = self.process.poll()
        if code is not None:
            raise CliError(f"The robot's process ended with exit code {code}{self._last_words()}.")

    def wait_ready(self) -> None:
        """Wait until it is on the network.

        Raises:
            CliError: it is not within :data:`READY_S` seconds.
        """
        deadline = time.monotonic() + READY_S
        while time.monotonic() < deadline:
            with contextlib.suppress(queue.Empty):
                message = json.loads(self._lines.get(timeout=0.1))
                if message.get("status") == "error":
                    raise CliError(f"The robot could not be served: {message.get('reason')}")
                if message.get("event") == "serving":
                    return
            if self.process.poll() is not None and self._lines.empty():
                self.check()
        raise CliError(f"The robot was not on the network within {READY_S:g} s.")

    def leave(self) -> None:
        """Ask it to stop the robot and depart, and wait for its end.

        Raises:
            CliError: it did not end in time, or not with success.
        """
        self.process.terminate()
        try:
            code = self.process.wait(DEPART_S)
        except subprocess.TimeoutExpired:
            raise CliError(f"The robot's process did not end within {DEPART_S:g} s.") from None
        if code not in (Exit.OK, Exit.INTERRUPTED):
            raise CliError(f"The robot's process ended with exit code {code}.")

    def _last_words(self) -> str:
        self._readers[1].join(1.0)
        last = ["", *"".join(self._complaints).strip().splitlines()][-1]
        return f": {last}" if last else ""


@contextmanager
def served_robot(robot: str, scene: str, peer_id: str, port: int, tenant: str) -> Iterator[RobotProcess]:
    """Serve ``robot`` in a scene, or without, at ``port`` while the block runs.

    Raises:
        CliError: it is not on the network within :data:`READY_S` seconds.
    """
    with started_robot(robot, scene, peer_id, port, tenant) as started:
        started.wait_ready()
        yield started


@contextmanager
def started_robot(robot: str, scene: str, peer_id: str, port: int, tenant: str) -> Iterator[RobotProcess]:
    """Start a robot as :func:`served_robot` does, and wait for nothing."""
    furnished = ("--set", f"scene={scene}") if scene else ()
    where = (*furnished, "--peer-id", peer_id, "--port", str(port), "--tenant", tenant)
    process = subprocess.Popen(
        [sys.executable, "-m", "strands_robots.cli", "serve", robot, *where, "--json", "--until-stdin-closes"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # Ctrl-C reaches only the demo, which then ends its robot in order.
        start_new_session=True,
    )
    try:
        yield RobotProcess(process)
    finally:
        if process.poll() is None:
            process.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):  # it is killed below
                process.wait(DEPART_S)
        process.kill()
        process.wait()
        for pipe in (process.stdin, process.stdout, process.stderr):
            if pipe is not None:
                with contextlib.suppress(BrokenPipeError):  # the process is gone, as it should be
                    pipe.close()


def _read_lines(pipe: IO[str] | None, take: Any) -> None:
    for line in pipe or ():
        take(line)


@dataclass(frozen=True, slots=True)
class AgentEvent:
    """Event of a device at the agent; ``at`` is its arrival, monotonic seconds."""

    name: str
    payload: Mapping[str, Any]
    at: float = field(default_factory=time.monotonic)


class Agent:
    """Agent that uses ``device_connect_agent_tools``."""

    def __init__(self, tools: Any, endpoint: str) -> None:
        self._tools = tools
        self.endpoint = endpoint

    def discover(self, device_id: str, within: float = 8.0) -> dict[str, Any]:
        """Return the device as discovery describes it.

        Raises:
            CliError: it does not appear within ``within`` seconds.
        """
        deadline = time.monotonic() + within
        while time.monotonic() < deadline:
            for device in self._use("discover_devices", refresh=True):
                if device.get("device_id") == device_id:
                    found: dict[str, Any] = device
                    return found
            time.sleep(_POLL_S * 5)
        raise CliError(f"{device_id} was not discovered within {within:g} s.")

    def call(self, device_id: str, function: str, **params: Any) -> dict[str, Any]:
        """Call a function and return its envelope.

        Raises:
            CliError: no answer, an error of the framework, or an envelope that says error.
        """
        result = self.ask(device_id, function, **params)
        if result.get("status") == "error":
            raise CliError(f"{function} was refused: {result.get('reason')}")
        return result

    def ask(self, device_id: str, function: str, **params: Any) -> dict[str, Any]:
        """Call a function whose refusal is an answer, and return its envelope.

        Raises:
            CliError: no answer, or an error of the framework.
        """
        answer = self._use("invoke_device", device_id, function, params)
        if not answer.get("success"):
            raise CliError(f"{function} was not answered: {answer.get('error')}")
        result = answer.get("result")
        if not isinstance(result, dict):
            raise CliError(f"{function} answered with {type(result).__name__}, not with an envelope.")
        return result

    @contextmanager
    def events(self, device_id: str) -> Iterator[EventStream]:
        """Subscribe to every event of a device for the length of the block."""
        with self._tools.subscribe(f"device({device_id}).event(*)") as subscription:
            yield EventStream(subscription)

    def _use(self, tool: str, *args: Any, **kwargs: Any) -> Any:
        with warnings.catch_warnings():
            # The framework will rename its two best known tools; agents in the field use the present names.
            warnings.simplefilter("ignore", DeprecationWarning)
            return getattr(self._tools, tool)(*args, **kwargs)


class EventStream:
    """Events as they arrive."""

    def __init__(self, subscription: Any) -> None:
        self._subscription = subscription

    def read(self) -> list[AgentEvent]:
        """Return the events that arrived since the last call."""
        arrived = []
        for message in self._subscription.read():
            name = _SEPARATOR.split(str(message.get("_subject", "")))[-1]
            params = message.get("params")
            arrived.append(AgentEvent(name, params if isinstance(params, Mapping) else message))
        return arrived

    def follow(self, seconds: float) -> Iterator[AgentEvent]:
        """Yield events for ``seconds``, as they arrive."""
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            yield from self.read()
            time.sleep(_POLL_S)
        yield from self.read()


@contextmanager
def connected_agent(port: int) -> Iterator[Agent]:
    """Connect the agent to loopback at ``port``, without the user's settings.

    Raises:
        CliError: no connection could be made.
        MissingExtraError: the agent tools are not installed.
    """
    try:
        import device_connect_agent_tools as tools  # noqa: PLC0415 - loaded when the demo runs
    except ModuleNotFoundError as exc:
        raise missing_extra("the demo", "device-connect") from exc
    for name in ("MESSAGING_CREDENTIALS_FILE", "NATS_CREDENTIALS_FILE", "ZENOH_LISTEN", "STRANDS_FLEET"):
        settings.put(name, "")
    for part in ("CA", "CERT", "KEY"):
        settings.put(f"MESSAGING_TLS_{part}_FILE", "")
    settings.put("MESSAGING_BACKEND", "zenoh")
    settings.put("DEVICE_CONNECT_DISCOVERY_MODE", "d2d")
    endpoint = f"tcp/127.0.0.1:{port}"
    try:
        tools.connect(nats_url=endpoint, zone=TENANT, request_timeout=10.0)
    except Exception as exc:
        raise CliError(f"The agent could not connect to {endpoint}: {exc}") from exc
    try:
        yield Agent(tools, endpoint)
    finally:
        tools.disconnect()
