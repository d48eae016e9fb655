"""Robots of one network, as the ``robot_mesh`` tool calls them.

Each verb joins the network for itself, answers with an envelope and never raises.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from typing import TYPE_CHECKING, Any

from strands_robots import settings
from strands_robots.envelope import Envelope, error, success
from strands_robots.errors import RefusalError, StrandsRobotsError, UnreachableError
from strands_robots.fleet.adapter import STOP_S
from strands_robots.fleet.callers import TOOL
from strands_robots.fleet.mesh_settings import MeshSettings
from strands_robots.fleet.profiles import profile_for
from strands_robots.fleet.refusals import said
from strands_robots.fleet.stop_answers import combined_verdict, roster_verdict
from strands_robots.safety.scope import EVERY_ROBOT, Scope
from strands_robots.utils import ValidationError

if TYPE_CHECKING:
    from strands_robots.fleet.adapter import FoundRobot, NetworkAdapter

ANSWER_S = 10.0

OWN_BYTES = 16_000
"""Size of what the list of robots says on one robot's own verbs."""


def network() -> Robots:
    """Return those of Device Connect, of the mesh where it is absent or off.

    They are of the default connection profile, ``STRANDS_FLEET``, if there is one.
    """
    absent = importlib.util.find_spec("device_connect_edge") is None
    off = settings.raw("STRANDS_ROBOT_MESH_DC").lower() in settings.FALSE_SPELLINGS
    return Robots(on_mesh if absent or off or _on_mesh_alone() else on_device_connect)


def _on_mesh_alone() -> bool:
    try:
        profile = profile_for(None, {})
    except ValidationError:
        # Joining says what is wrong with it.
        return False
    return profile is not None and not profile.reaches_devices({})


class Robots:
    """Robots of one network; a robot without an answer is an error.

    Args:
        joined: joins the network for the length of a block.
    """

    def __init__(self, joined: Callable[[], AbstractContextManager[NetworkAdapter]]) -> None:
        self.joined = joined

    def peers(self) -> Envelope:
        """List all that are in reach, with type, state and functions.

        Verbs of its own come with their parameters, in the robot's words.
        """

        def listed(there: NetworkAdapter) -> Envelope:
            found = there.listed()
            functions = there.describe_each([each.id for each in found])
            rows = [_row(each, functions.get(each.id)) for each in found]
            if not rows:
                return error(f"No robot answered. {there.stale}".strip(), peers=[])
            names = ", ".join(each.id for each in found)
            return success(f"{len(rows)} robots: {names}. {there.stale}".strip(), peers=rows)

        return self._answer(listed)

    def tell(self, target: str, instruction: str, policy_provider: str, duration: float) -> Envelope:
        """Have the robot start a task."""
        task = {"instruction": instruction, "policy_provider": policy_provider, "duration": duration}
        return self._answer(lambda there: there.call(target, there.starts, task, ANSWER_S))

    def call(self, target: str, action: str, arguments: Mapping[str, Any], seconds: float = ANSWER_S) -> Envelope:
        """Call any verb of the robot, and wait as long as it lasts by its description."""

        def called(there: NetworkAdapter) -> Envelope:
            verb = there.verb(target, action)
            return there.call(target, action, arguments, seconds + (verb.lasts_s if verb is not None else 0.0))

        return self._answer(called)

    def status(self, target: str) -> Envelope:
        """Ask the robot for its status."""
        return self._answer(lambda there: there.call(target, there.reads["status"], {}, ANSWER_S))

    def release_torque(self, target: str) -> Envelope:
        """Call the robot's ``releaseTorque``."""
        return self._answer(lambda there: there.call(target, "releaseTorque", {}, ANSWER_S))

    def stop(self, target: str, robot_name: str = "") -> Envelope:
        """Stop one robot, or every robot at once; answers by name.

        ``robot_name`` stops one robot of the target's world alone.
        """

        def stopped(there: NetworkAdapter) -> Envelope:
            if target:
                answer = there.stop(target, STOP_S, robot_name, insist=True)
                return combined_verdict({target: answer} if answer is not None else {})
            return roster_verdict(there.stop_all(STOP_S)[1])

        return self._answer(stopped, stopped=None)

    def emergency_stop(self, reason: str, scope: Scope = EVERY_ROBOT) -> Envelope:
        """Stop and lock every robot, or those of ``scope``; answers by name.

        Where none of them is there, every robot is stopped.
        """
        return self._answer(lambda there: there.verdict(there.emergency_stop(reason, scope=scope)), stopped=None)

    def _answer(self, work: Callable[[NetworkAdapter], Envelope], **fields: Any) -> Envelope:
        """Return what ``work`` answers on a connection of its own, or an error envelope."""
        try:
            with self.joined() as there:
                return work(there)
        except RefusalError as refusal:
            return error(said(refusal), **fields)
        except (StrandsRobotsError, LookupError, TimeoutError, RuntimeError, ValueError) as exc:
            return error(str(exc.args[0]) if exc.args else type(exc).__name__, **fields)


@contextmanager
def on_mesh() -> Iterator[NetworkAdapter]:
    """Join the native mesh as a peer without a robot.

    Raises:
        UnreachableError: the default connection profile has no mesh, or this process is on another one.
        ValidationError: that profile cannot be used.
    """
    from strands_robots.fleet.mesh import joining  # noqa: PLC0415 - the network is loaded when it is used
    from strands_robots.fleet.mesh.network import MeshNetwork  # noqa: PLC0415 - as above
    from strands_robots.mesh.wire_identity import visitor_id  # noqa: PLC0415 - as above

    profile = profile_for(None, {})
    stated = None if profile is None else profile.mesh
    if profile is not None and stated is None:
        # The mesh of the environment may be another fleet's.
        raise UnreachableError(f"the connection profile {profile.label} has no mesh")
    with MeshSettings(stated or {}).held(), joining.joined_mesh(None, visitor_id(TOOL), "tool") as mesh:
        yield MeshNetwork.joined(mesh)


@contextmanager
def on_device_connect() -> Iterator[NetworkAdapter]:
    """Join Device Connect where the profile or the environment says, else here.

    Raises:
        UnreachableError: it cannot be reached.
        ValidationError: the default connection profile cannot be used, or the network needs authentication.
    """
    from strands_robots.device_connect.links import insecure_opt_in, usual_link  # noqa: PLC0415 - the network is loaded when it is used
    from strands_robots.fleet.device_connect.network import DeviceConnectNetwork  # noqa: PLC0415 - as above

    profile = profile_for(None, {})
    flags = None if profile is None else profile.flags({})
    link = usual_link() if flags is None else flags.link()
    if not link.loopback_only:
        insecure_opt_in(None if flags is None else flags.opted_in, link, stated=True)
    network = DeviceConnectNetwork(link, TOOL)
    network.open()
    try:
        yield network
    finally:
        network.close()


def _row(found: FoundRobot, functions: object) -> dict[str, Any]:
    """Return what a list of robots says on one."""
    from strands_robots.serving.advertised import RobotDescription, fitting  # noqa: PLC0415 - loaded when it is used

    description = RobotDescription.of(functions)
    verbs = description.verbs.values()
    # Of a verb that was only named there is no more to say.
    described = (each for each in verbs if each.own and (each.stated or each.summary))
    own = dict(fitting(((each.name, f"({each.takes}) {each.summary}") for each in described), OWN_BYTES))
    return {
        "id": found.id,
        "type": found.type,
        "status": found.status,
        "functions": [each.name for each in verbs],
        **({"own_verbs": own} if own else {}),
        **({"note": description.absent} if description.absent and functions is not None else {}),
    }
