"""The networks behind the ``robot_mesh`` tool: one protocol, two of them."""

from __future__ import annotations

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

SOURCE = "robot-mesh-tool"
"""The name that the tool's calls carry; what a robot's allowlist has to hold."""

ANSWER_S = 10.0
STOP_S = 5.0
ESTOP_S = 1.5
"""Seconds in which robots answer an emergency stop; it is sent again and again until then."""


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
    """The network that is in use: Device Connect, unless ``STRANDS_ROBOT_MESH_DC`` says off."""
    if settings.raw("STRANDS_ROBOT_MESH_DC").lower() in settings.FALSE_WORDS:
        return NativeMesh()
    return DeviceConnect()


class NativeMesh:
    """The native mesh, which this release does not have: every verb says so."""

    _REASON = "The native mesh is not part of this release; unset STRANDS_ROBOT_MESH_DC to use Device Connect."

    def peers(self) -> Envelope:
        return error(self._REASON)

    def tell(self, target: str, instruction: str, policy_provider: str, duration: float) -> Envelope:
        return error(self._REASON)

    def status(self, target: str) -> Envelope:
        return error(self._REASON)

    def stop(self, target: str) -> Envelope:
        return error(self._REASON, stopped=None)

    def emergency_stop(self, reason: str) -> Envelope:
        return error(self._REASON, stopped=None)


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
