"""Networks of the ``robot_mesh`` tool, with the same verbs.

Each verb answers with an envelope and never raises.
"""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from strands_robots import settings
from strands_robots.envelope import Envelope, error, success
from strands_robots.errors import StrandsRobotsError
from strands_robots.fleet.device_connect.stops import stop_and_lock, stop_everything
from strands_robots.fleet.mesh.discovery import discover, in_reach
from strands_robots.fleet.mesh.stops import lock_peers, stop_answer, stop_peers
from strands_robots.fleet.stop_answers import OnOutcome, combined_verdict, roster_verdict
from strands_robots.safety.peer_answers import enrolled_peers
from strands_robots.safety.scope import EVERY_ROBOT, Scope
from strands_robots.safety.stop_roster import StopOutcome
from strands_robots.utils import MissingExtraError, ValidationError, finite, near

if TYPE_CHECKING:
    from strands_robots.device_connect import FleetClient
    from strands_robots.mesh import Mesh
    from strands_robots.serving.advertised import AdvertisedVerb

SOURCE = "robot-mesh-tool"
"""Caller's name in the tool's calls; an allowlist of a robot must include it."""

ANSWER_S = 10.0
STOP_S = 5.0
DESCRIBE_S = 2.0
"""Seconds in which a peer of the mesh has to describe a verb of its own before that is called."""

LIST_S, LISTED_AT_ONCE = 1.0, 32
"""Seconds in which the peers of a list have to describe their verbs, and how many are asked at once."""

ALWAYS_SENT = ("stop", "releaseTorque")
"""Actions that take energy away: they are sent to a peer that was not seen, too."""

OWN_BYTES = 16_000
"""Size of what the list of robots says on one robot's own verbs."""


def ignore_outcome(outcome: StopOutcome) -> None:
    """Do without the outcome: the envelope says it."""


class MeshUnavailableError(StrandsRobotsError, RuntimeError):
    """The native mesh is switched off, or has no session."""


class NoPeerError(StrandsRobotsError, LookupError):
    """No peer of the mesh has that id."""


class SilentPeerError(StrandsRobotsError, TimeoutError):
    """The peer did not answer in time."""


def network() -> DeviceConnect | NativeMesh:
    """Return Device Connect, or the mesh where it is absent or switched off."""
    absent = importlib.util.find_spec("device_connect_edge") is None
    if absent or settings.raw("STRANDS_ROBOT_MESH_DC").lower() in settings.FALSE_SPELLINGS:
        return NativeMesh()
    return DeviceConnect()


@contextmanager
def joined_mesh(robot: Any, peer_id: str | None, peer_type: str) -> Iterator[Mesh]:
    """Join the native mesh for the length of the block.

    Raises:
        MeshUnavailableError: the mesh is off, or no session could be opened.
        ValueError: ``peer_id`` is refused.
    """
    from strands_robots.mesh import init_mesh  # noqa: PLC0415 - the network is loaded when it is used

    mesh = init_mesh(robot, peer_id, peer_type)
    if mesh is None:
        raise MeshUnavailableError("The native mesh is off: STRANDS_MESH switches it off.")
    try:
        if not mesh.alive:
            raise MeshUnavailableError("The native mesh has no session; the log says why.")
        yield mesh
    finally:
        mesh.close()


class NativeMesh:
    """Robots on the native mesh, called by a peer without a robot."""

    def peers(self) -> Envelope:
        """List every peer in reach, with its type, state and actions.

        Actions are those that it describes, of an earlier release or a silent one those of its kind.
        """

        def listed(mesh: Mesh) -> Envelope:
            discover(mesh)
            rows = [row for row in mesh.peers if row["reachable"]]
            functions = _functions_of(mesh, [row["peer_id"] for row in rows if "robot_kind" in row])
            return _peer_list(
                [
                    {
                        "id": row["peer_id"],
                        "type": row["type"],
                        "status": row.get("task_status", ""),
                        **(_verbs(functions[row["peer_id"]]) if row["peer_id"] in functions else _verbs_of_kind(row)),
                    }
                    for row in rows
                ]
            )

        return _on_mesh(listed)

    def tell(self, target: str, instruction: str, policy_provider: str, duration: float) -> Envelope:
        """Send the peer a ``start``."""
        return self._request(
            target, action="start", instruction=instruction, policy_provider=policy_provider, duration=duration
        )

    def call(self, target: str, action: str, arguments: Mapping[str, Any], seconds: float = ANSWER_S) -> Envelope:
        """Send the peer any action; wait as long as a verb of its own lasts."""
        return self._request(target, seconds, **{**arguments, "action": action})

    def status(self, target: str) -> Envelope:
        """Ask the peer for its ``status``."""
        return self._request(target, action="status")

    def release_torque(self, target: str) -> Envelope:
        """Send the peer a ``releaseTorque``."""
        return self._request(target, action="releaseTorque")

    def stop(self, target: str, robot_name: str = "", on_outcome: OnOutcome = ignore_outcome) -> Envelope:
        """Stop one peer, or every peer in reach at once; answers by name.

        ``robot_name`` stops one robot of the target's world alone. ``on_outcome`` takes the outcome of a stop of all.
        """

        def stopped(mesh: Mesh) -> Envelope:
            command = {"action": "stop", **({"robot_name": robot_name} if robot_name else {})}
            if target:
                return combined_verdict(
                    {target: stop_answer(target, _reply(mesh, target, command, STOP_S), enrolled_peers())}
                )
            answers, outcome = stop_peers(mesh)
            on_outcome(outcome)
            return roster_verdict(answers, outcome)

        return _on_mesh(stopped, stopped=None)

    def emergency_stop(
        self, reason: str, signing_key: Any = None, scope: Scope = EVERY_ROBOT, on_outcome: OnOutcome = ignore_outcome
    ) -> Envelope:
        """Send the mesh's emergency stop, again while a peer has not confirmed it.

        A peer that was seen and did not answer is named. Every repetition is the same stop, ``estop_id``.

        Args:
            scope: the robots that it is for. Where none of them is there, every robot is stopped.
            on_outcome: takes the outcome.
        """

        def stopped(mesh: Mesh) -> Envelope:
            answers, outcome = lock_peers(mesh, signing_key, scope)
            on_outcome(outcome)
            return {**roster_verdict(answers, outcome), "estop_id": outcome.report.estop_id, **scope.field()}

        return _on_mesh(stopped, stopped=None)

    def _request(self, target: str, seconds: float = ANSWER_S, **command: Any) -> Envelope:
        def requested(mesh: Mesh) -> Envelope:
            try:
                return ask(mesh, target, command, lambda verb: seconds + (verb.lasts_s if verb is not None else 0.0))
            except (NoPeerError, SilentPeerError) as exc:
                return error(str(exc))

        return _on_mesh(requested)


def ask(
    mesh: Mesh,
    target: str,
    command: Mapping[str, Any],
    seconds: Callable[[AdvertisedVerb | None], float],
    fit: Callable[[AdvertisedVerb], Mapping[str, Any]] | None = None,
) -> Envelope:
    """Have a peer carry an action out; return its answer.

    Args:
        mesh: the peer that asks.
        target: id of the peer that is asked.
        command: the action with its arguments.
        seconds: gives the time to wait for the answer, from the peer's description of a verb of its own.
        fit: gives the arguments of a verb of its own as its description has them.

    Raises:
        NoPeerError: no peer has this id.
        SilentPeerError: it did not answer in time.
        ValidationError: an argument is not finite, or does not fit.
    """
    action = str(command["action"])
    for name, value in command.items():
        finite(name, value)
    there = _seen(mesh, target)
    if not there and action not in ALWAYS_SENT:
        raise NoPeerError(_absent(mesh, target))
    verb = _own_verb(mesh, target, action) if there else None
    fitted = fit(verb) if fit is not None and verb is not None else {}
    sent = {**command, **fitted, "action": action}
    reply = mesh.send(target, sent, seconds(verb) if there else STOP_S)
    if reply.get("type") == "response":
        result = reply.get("result")
        return result if isinstance(result, dict) else error(f"{target} answered with an unknown result shape.")
    if reply.get("status") == "timeout":
        if not there:
            raise NoPeerError(_absent(mesh, target))
        raise SilentPeerError(f"{target} did not answer.")
    return error(f"{target}: {reply.get('error') or reply.get('reason') or 'refused'}")


def _seen(mesh: Mesh, target: str) -> bool:
    """Return whether a peer is in reach, once that can be known."""
    from strands_robots.mesh.core import wait_for_peer  # noqa: PLC0415 - loaded when it is used
    from strands_robots.mesh.transport.zenoh_config import DISCOVERY_S, discovery_timeout  # noqa: PLC0415 - as above

    time.sleep(DISCOVERY_S)
    # A loaded machine gets twice the time.
    return wait_for_peer(mesh, target, max(discovery_timeout(DISCOVERY_S) - DISCOVERY_S, DISCOVERY_S))


def _absent(mesh: Mesh, target: str) -> str:
    return f"No peer {target!r} is on the mesh.{near(target, in_reach(mesh))}"


def _own_verb(mesh: Mesh, target: str, action: str) -> AdvertisedVerb | None:
    """Return a peer's own verb as it describes it, or None."""
    from strands_robots.serving.advertised import find_verb  # noqa: PLC0415 - loaded when it is used
    from strands_robots.serving.peer_verbs import PEER_VERBS  # noqa: PLC0415 - as above

    return None if action in PEER_VERBS else find_verb(_functions(mesh, target, DESCRIBE_S), action)


def _functions(mesh: Mesh, target: str, seconds: float) -> list[Any] | None:
    """Return the functions that a peer describes; None if it does not."""
    result = mesh.send(target, {"action": "describe"}, seconds).get("result")
    functions = result.get("functions") if isinstance(result, Mapping) else None
    return functions if isinstance(functions, list) else None


def _functions_of(mesh: Mesh, peers: Collection[str]) -> dict[str, list[Any]]:
    """Return the functions of the peers that describe them in time."""
    ends, found = time.monotonic() + LIST_S, dict[str, list[Any]]()

    def described(peer: str) -> None:
        left = ends - time.monotonic()
        functions = _functions(mesh, peer, left) if left > 0 else None
        if functions is not None:
            found[peer] = functions

    if peers:
        with ThreadPoolExecutor(min(len(peers), LISTED_AT_ONCE), "describe") as pool:
            list(pool.map(described, peers))
    return found


def _verbs(functions: object) -> dict[str, Any]:
    """Return what a list of robots says on the verbs of one."""
    from strands_robots.serving.advertised import RobotDescription, fitting  # noqa: PLC0415 - loaded when it is used

    description = RobotDescription.of(functions)
    verbs = description.verbs.values()
    own = dict(fitting(((each.name, f"({each.takes}) {each.summary}") for each in verbs if each.own), OWN_BYTES))
    return {
        "functions": [each.name for each in verbs],
        **({"own_verbs": own} if own else {}),
        **({"note": description.absent} if description.absent else {}),
    }


def _verbs_of_kind(row: Mapping[str, Any]) -> dict[str, Any]:
    """Return the same of a mesh peer by its presence alone."""
    from strands_robots.serving.advertised import own_names  # noqa: PLC0415 - loaded when it is used
    from strands_robots.serving.peer_verbs import KINDS  # noqa: PLC0415 - as above

    return {"functions": [*KINDS.get(str(row.get("robot_kind")), ()), *own_names(row.get("own_verbs"))]}


def _reply(mesh: Mesh, target: str, command: dict[str, Any], seconds: float) -> dict[str, Any]:
    """Send a command once ``target`` is in reach or known not to be."""
    from strands_robots.mesh.core import wait_for_peer  # noqa: PLC0415 - loaded when it is used
    from strands_robots.mesh.transport.zenoh_config import DISCOVERY_S, discovery_timeout  # noqa: PLC0415 - as above

    time.sleep(DISCOVERY_S)
    wait_for_peer(mesh, target, discovery_timeout(DISCOVERY_S) - DISCOVERY_S)
    return mesh.send(target, command, seconds)


def _on_mesh(work: Callable[[Mesh], Envelope], **fields: Any) -> Envelope:
    """Return what ``work`` answers on a connection of its own, or an error envelope."""
    from strands_robots.mesh.transport import TransportError  # noqa: PLC0415 - the network is loaded when it is used
    from strands_robots.mesh.wire_identity import visitor_id  # noqa: PLC0415 - as above

    try:
        with joined_mesh(None, visitor_id(SOURCE), "tool") as mesh:
            return work(mesh)
    except (MeshUnavailableError, TransportError, ValueError) as exc:
        return error(str(exc), **fields)


class DeviceConnect:
    """Robots on Device Connect; a robot without an answer is an error."""

    def peers(self) -> Envelope:
        """List every device that answers, with its type, state and functions.

        Verbs of its own come with their parameters, in the robot's words.
        """

        def listed(fleet: FleetClient) -> Envelope:
            rows = [
                {
                    "id": peer.id,
                    "type": peer.type,
                    "status": peer.status.get("availability", ""),
                    **_verbs(peer.functions),
                }
                for peer in fleet.peers()
            ]
            return _peer_list(rows, fleet.stale)

        return _on_fleet(listed)

    def tell(self, target: str, instruction: str, policy_provider: str, duration: float) -> Envelope:
        """Call the device's ``execute``."""
        params = {"instruction": instruction, "policy_provider": policy_provider, "duration": duration}
        return _on_fleet(lambda fleet: fleet.call(target, "execute", params, ANSWER_S))

    def call(self, target: str, action: str, arguments: Mapping[str, Any], seconds: float = ANSWER_S) -> Envelope:
        """Call any verb of the device, and wait as long as it lasts by its description."""

        def called(fleet: FleetClient) -> Envelope:
            verb = fleet.verb(target, action)
            return fleet.call(target, action, dict(arguments), seconds + (verb.lasts_s if verb is not None else 0.0))

        return _on_fleet(called)

    def status(self, target: str) -> Envelope:
        """Call the device's ``getStatus``."""
        return _on_fleet(lambda fleet: fleet.call(target, "getStatus", {}, ANSWER_S))

    def release_torque(self, target: str) -> Envelope:
        """Call the device's ``releaseTorque``."""
        return _on_fleet(lambda fleet: fleet.call(target, "releaseTorque", {}, ANSWER_S))

    def stop(self, target: str, robot_name: str = "") -> Envelope:
        """Stop one device, or every device at once; answers by name.

        ``robot_name`` stops one robot of the target's world alone.
        """

        def stopped(fleet: FleetClient) -> Envelope:
            if target:
                return combined_verdict({target: fleet.stop(target, STOP_S, robot_name)})
            return stop_everything(fleet)

        return _on_fleet(stopped, stopped=None)

    def emergency_stop(self, reason: str, scope: Scope = EVERY_ROBOT) -> Envelope:
        """Send an emergency stop on a connection of its own; answers by name.

        A device that is in reach and did not answer it gets a plain ``stop`` as well.

        Args:
            scope: the robots that it is for. Where none of them is there, every robot is stopped.
        """
        return _on_fleet(lambda fleet: stop_and_lock(fleet, reason, scope), stopped=None)


def _peer_list(rows: list[dict[str, Any]], stale: str = "") -> Envelope:
    if not rows:
        return error(f"No robot answered. {stale}".strip(), peers=[])
    return success(f"{len(rows)} robots: {', '.join(row['id'] for row in rows)}. {stale}".strip(), peers=rows)


def _on_fleet(work: Callable[[FleetClient], Envelope], **fields: Any) -> Envelope:
    """Return what ``work`` answers on a connection of its own, or an error envelope."""
    from device_connect_edge.messaging import MessagingError  # noqa: PLC0415 - the network is loaded when it is used

    from strands_robots.device_connect import FleetClient  # noqa: PLC0415 - as above
    from strands_robots.device_connect.links import insecure_opt_in, usual_link  # noqa: PLC0415

    try:
        link = usual_link()
        if not link.loopback_only:
            insecure_opt_in(None, link, stated=True)
        with FleetClient(link, SOURCE) as fleet:
            return work(fleet)
    except (MissingExtraError, ValidationError) as exc:
        return error(str(exc), **fields)
    except (LookupError, TimeoutError, RuntimeError) as exc:
        return error(str(exc.args[0]) if exc.args else type(exc).__name__, **fields)
    except MessagingError as exc:
        return error(f"The network does not carry this: {exc}", **fields)
