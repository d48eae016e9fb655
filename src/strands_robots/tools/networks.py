"""The networks behind the ``robot_mesh`` tool: one protocol, two of them."""

from __future__ import annotations

import importlib.util
import math
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Protocol

from strands_robots import settings
from strands_robots.envelope import Envelope, error, success, text_of
from strands_robots.safety.stopping import explain, grade
from strands_robots.utils import MissingExtraError, ValidationError

if TYPE_CHECKING:
    from strands_robots.device_connect import FleetClient
    from strands_robots.device_connect.client import Peer
    from strands_robots.mesh import Mesh

SOURCE = "robot-mesh-tool"
"""The name that the tool's calls carry; what a robot's allowlist has to hold."""

ANSWER_S = 10.0
STOP_S = 5.0
ESTOP_S = 1.5
"""Seconds in which robots answer an emergency stop; it is sent again and again until then."""

AGAIN_S, LOOK_S = 1.0, 0.05


class RobotNetwork(Protocol):
    """What the tool asks of a network. Every verb answers with an envelope and raises nothing."""

    def peers(self) -> Envelope:
        """Who is there."""

    def tell(self, target: str, instruction: str, policy_provider: str, duration: float) -> Envelope:
        """Have ``target`` follow an instruction; returns once it has begun."""

    def status(self, target: str) -> Envelope:
        """What ``target`` is doing."""

    def stop(self, target: str) -> Envelope:
        """Stop ``target``; with an empty one, every robot."""

    def emergency_stop(self, reason: str) -> Envelope:
        """Stop and lock every robot."""


def network() -> RobotNetwork:
    """The network that is in use: Device Connect, unless it is absent or ``STRANDS_ROBOT_MESH_DC`` says off."""
    absent = importlib.util.find_spec("device_connect_edge") is None
    if absent or settings.raw("STRANDS_ROBOT_MESH_DC").lower() in settings.FALSE_SPELLINGS:
        return NativeMesh()
    return DeviceConnect()


class NativeMesh:
    """Robots on the native mesh, asked by a peer of this process that has no robot. Its silence is an error too."""

    def peers(self) -> Envelope:
        """Every peer in reach, with its type and state."""

        def listed(console: Mesh) -> Envelope:
            _hear(console)
            rows = [
                {"id": row["peer_id"], "type": row["type"], "status": row.get("task_status", "")}
                for row in console.peers
                if row["reachable"]
            ]
            if not rows:
                return error("No robot answered.", peers=[])
            return success(f"{len(rows)} robots: {', '.join(row['id'] for row in rows)}.", peers=rows)

        return _with_console(listed)

    def tell(self, target: str, instruction: str, policy_provider: str, duration: float) -> Envelope:
        """The peer's ``start``."""
        command = {
            "action": "start",
            "instruction": instruction,
            "policy_provider": policy_provider,
            "duration": duration,
        }
        return _with_console(lambda console: _answer_of(target, _asked(console, target, command, ANSWER_S)))

    def status(self, target: str) -> Envelope:
        """The peer's ``status``."""
        command = {"action": "status"}
        return _with_console(lambda console: _answer_of(target, _asked(console, target, command, ANSWER_S)))

    def stop(self, target: str) -> Envelope:
        """The peer's ``stop``, or that of every peer in reach at once; answers by name."""

        def stopped(console: Mesh) -> Envelope:
            command = {"action": "stop"}
            if target:
                return verdict_of({target: _stop_answer(target, _asked(console, target, command, STOP_S))})
            return _stop_all(console, lambda: console.broadcast(command, ESTOP_S))

        return _with_console(stopped, stopped=None)

    def emergency_stop(self, reason: str) -> Envelope:
        """The mesh's emergency stop, sent at once; and again for who is seen since and has not confirmed it.

        Who was seen and gave no answer is named. Each of them holds the robots; a resume of the operator's frees them
        of all. ``estop_id`` names the first.
        """

        def stopped(console: Mesh) -> Envelope:
            return {**_stop_all(console, console.emergency_stop), "estop_id": console.lockout_epoch}

        return _with_console(stopped, stopped=None)


def _stop_all(console: Mesh, stop: Callable[[], list[dict[str, Any]]]) -> Envelope:
    """Send a stop now, and again, at most once in :data:`AGAIN_S`, while somebody in reach has not confirmed it."""
    seen: set[str] = set()
    answers: dict[str, Envelope] = {}
    asked = time.monotonic()

    def ask() -> None:
        nonlocal asked
        asked = time.monotonic()
        for reply in stop():
            name = reply["responder_id"]
            if name != console.peer_id:
                answers[name] = _stop_answer(name, reply)

    def unconfirmed() -> bool:
        seen.update(_in_reach(console))
        return any(not answers.get(name, {}).get("stopped") for name in seen)

    ask()
    _hear(console, lambda: ask() if unconfirmed() and time.monotonic() - asked >= AGAIN_S else None)
    if unconfirmed():
        ask()
    silent: dict[str, Envelope] = {name: error(f"{name} did not answer.", stopped=None) for name in seen}
    return verdict_of(silent | answers)


def _stop_answer(target: str, reply: dict[str, Any]) -> Envelope:
    if reply.get("status") in ("timeout", "error"):
        return error(f"{target} did not answer.", stopped=None)
    result = reply.get("result")
    if grade(result).stopped:
        return success("stopped", stopped=True)
    return error(explain(result) if result is not None else str(reply.get("error", "")), stopped=False)


def _answer_of(target: str, reply: dict[str, Any]) -> Envelope:
    if reply.get("status") == "timeout":
        return error(f"{target} did not answer.")
    if reply.get("type") != "response":
        return error(f"{target}: {reply.get('error', 'refused')}")
    result = reply.get("result")
    return result if isinstance(result, dict) else error(f"{target} answered nothing known.")


def _in_reach(console: Mesh) -> list[str]:
    return [row["peer_id"] for row in console.peers if row["reachable"]]


def _hear(console: Mesh, meanwhile: Callable[[], object] = lambda: None) -> None:
    """Return when it is known who is there; ``meanwhile`` is called again and again.

    Who connects here, or to what this process connects to and found nobody at, may pause between two tries.
    """
    from strands_robots.mesh.transport.zenoh_config import DISCOVERY_S, LINK_DISCOVERY_S  # noqa: PLC0415 - loaded when it is used

    began, found = time.monotonic(), math.inf
    listens, connects = settings.items("ZENOH_LISTEN"), settings.items("ZENOH_CONNECT")
    while (now := time.monotonic()) < began + LINK_DISCOVERY_S:
        if _in_reach(console):
            found = min(found, now)
        known = now >= found + DISCOVERY_S if connects else now >= began + DISCOVERY_S
        if known and not listens:
            return
        meanwhile()
        time.sleep(LOOK_S)


def _asked(console: Mesh, target: str, command: dict[str, Any], seconds: float) -> dict[str, Any]:
    """What ``target`` replies, asked when it is in reach or when it is known who is."""
    from strands_robots.mesh.core import wait_for_peer  # noqa: PLC0415 - loaded when it is used
    from strands_robots.mesh.transport.zenoh_config import DISCOVERY_S, discovery_timeout  # noqa: PLC0415 - as above

    time.sleep(DISCOVERY_S)
    wait_for_peer(console, target, discovery_timeout(DISCOVERY_S) - DISCOVERY_S)
    return console.send(target, command, seconds)


def _with_console(work: Callable[[Mesh], Envelope], **fields: Any) -> Envelope:
    from strands_robots.mesh import init_mesh  # noqa: PLC0415 - the network is loaded when it is used
    from strands_robots.mesh.transport import TransportError  # noqa: PLC0415 - as above
    from strands_robots.mesh.wire_identity import visitor_id  # noqa: PLC0415

    try:
        console = init_mesh(None, visitor_id(SOURCE), "tool")
    except (TransportError, ValueError) as exc:
        return error(str(exc), **fields)
    if console is None or not console.alive:
        return error("The native mesh is off or has no session; see the log.", **fields)
    try:
        return work(console)
    finally:
        console.close()


class DeviceConnect:
    """Robots on Device Connect. A robot that does not answer is an error, never an empty success."""

    def peers(self) -> Envelope:
        """Every device that answers, with its type, state and functions."""

        def listed(fleet: FleetClient) -> Envelope:
            found = fleet.peers()
            rows = [
                {
                    "id": peer.id,
                    "type": peer.type,
                    "status": peer.status.get("availability", ""),
                    "functions": [str(each.get("name", "")) for each in peer.functions],
                }
                for peer in found
            ]
            if not rows:
                return error("No robot answered.", peers=[])
            return success(f"{len(rows)} robots: {', '.join(peer.id for peer in found)}.", peers=rows)

        return _with_fleet(listed)

    def tell(self, target: str, instruction: str, policy_provider: str, duration: float) -> Envelope:
        """The device's ``execute``."""
        params = {"instruction": instruction, "policy_provider": policy_provider, "duration": duration}
        return _with_fleet(lambda fleet: fleet.call(target, "execute", params, ANSWER_S))

    def status(self, target: str) -> Envelope:
        """The device's ``getStatus``."""
        return _with_fleet(lambda fleet: fleet.call(target, "getStatus", {}, ANSWER_S))

    def stop(self, target: str) -> Envelope:
        """The device's ``stop``, or that of every device at once; answers by name."""

        def stopped(fleet: FleetClient) -> Envelope:
            answers = {target: fleet.stop(target, STOP_S)} if target else fleet.stop_all(STOP_S)
            return verdict_of(answers)

        return _with_fleet(stopped, stopped=None)

    def emergency_stop(self, reason: str) -> Envelope:
        """An emergency stop on a connection of its own; who can be seen and gave no answer to it is asked to stop
        besides. Answers by name."""
        from strands_robots.device_connect.safety_controller import envelope, safety_controller  # noqa: PLC0415

        def stopped(fleet: FleetClient) -> Envelope:
            with ThreadPoolExecutor(1) as pool:
                controller = safety_controller(SOURCE, fleet.link)
                try:
                    seen = pool.submit(fleet.peers)
                    report = controller.stop((), reason, deadline_s=ESTOP_S)
                finally:
                    controller.close()
            answered = {*report.stopped, *report.not_stopped, *report.refused}
            rest = [peer.id for peer in seen.result() if peer.id not in answered and _can_stop(peer)]
            if not rest:
                return envelope(report)
            answers: dict[str, Envelope] = {name: success("locked and still", stopped=True) for name in report.stopped}
            for name, answer in {**report.not_stopped, **report.refused}.items():
                answers[name] = error(answer.why, stopped=False)
            asked = {name: fleet.stop(name, STOP_S) for name in rest}
            return {**verdict_of(answers | asked), "not_locked": rest}

        return _with_fleet(stopped, stopped=None)


def _can_stop(peer: Peer) -> bool:
    return any(each.get("name") in ("stop", "stopMotion") for each in peer.functions)


def verdict_of(answers: Mapping[str, Envelope]) -> Envelope:
    """One answer for the stop of several robots: success only when every one of them confirmed it."""
    if not answers:
        return error("No robot that can be stopped answered.", stopped=None, robots={})
    outcomes = {name: grade(answer) for name, answer in answers.items()}
    # The client says "stopped: null" of a robot that did not answer.
    silent = [name for name, answer in answers.items() if answer.get("stopped", False) is None]
    moving = [name for name, outcome in outcomes.items() if outcome.stopped is False and name not in silent]
    unknown = [name for name, outcome in outcomes.items() if outcome.stopped is None and name not in silent]
    fields: dict[str, Any] = {
        "stopped": not moving if not (silent or unknown) or moving else None,
        "not_stopped": moving,
        "silent": silent + unknown,
        "robots": {name: text_of(answer) or explain(answer) for name, answer in answers.items()},
    }
    if fields["stopped"]:
        return success(f"Stopped: {', '.join(answers)}.", **fields)
    said = [f"DID NOT STOP: {', '.join(moving)}"] if moving else []
    said += [f"silent, so nobody knows: {', '.join(silent + unknown)}"] if silent or unknown else []
    return error("; ".join(said) + ".", **fields)


def _with_fleet(work: Callable[[FleetClient], Envelope], **fields: Any) -> Envelope:
    """``work`` on a connection of its own; whatever stands in its way becomes an error envelope."""
    try:
        with _reached() as fleet:
            return work(fleet)
    except (MissingExtraError, ValidationError) as exc:
        return error(str(exc), **fields)
    except (LookupError, TimeoutError, RuntimeError) as exc:
        return error(str(exc.args[0]) if exc.args else type(exc).__name__, **fields)
    except _messaging_error() as exc:
        return error(f"The network does not carry this: {exc}", **fields)


@contextmanager
def _reached() -> Iterator[FleetClient]:
    from strands_robots.device_connect import FleetClient  # noqa: PLC0415 - the network is loaded when it is used
    from strands_robots.device_connect.links import insecure_opt_in, usual_link  # noqa: PLC0415

    link = usual_link()
    if not link.loopback_only:
        insecure_opt_in(None, link, stated=True)
    with FleetClient(link, SOURCE) as fleet:
        yield fleet


def _messaging_error() -> type[Exception]:
    from device_connect_edge.messaging import MessagingError  # noqa: PLC0415 - as above

    error_type: type[Exception] = MessagingError
    return error_type
