"""The factory ``Robot(name)``, and ``run``, which serves a robot until a signal."""

from __future__ import annotations

import logging
import re
import sys
import threading
from collections.abc import Callable, Collection, Mapping
from contextlib import nullcontext
from functools import cache, partial
from pathlib import Path
from typing import Any, NoReturn

from strands_robots import settings
from strands_robots._mesh_switch import mesh_env_request
from strands_robots.adapted import behind_contract
from strands_robots.contract import has_gate, put_away
from strands_robots.envelope import is_error, text_of
from strands_robots.moved import METHODS
from strands_robots.plug_ins import PlugIn, PlugIns, takes
from strands_robots.safety.scope import own_cell
from strands_robots.safety.stopping import StopVerdict
from strands_robots.tags import own_tags
from strands_robots.utils import MissingExtraError, ValidationError, choice, own_device_id, shown
from strands_robots.utils import peer_id as valid_peer_id

logger = logging.getLogger(__name__)

HARDWARE_OPTIONS = ("control_hz", "joint_ranges", "stop_level", "rest_pose", "model", "speed_limit")

DETECTOR = "detector"
"""Option of a real robot that is set on it: an :class:`~strands_robots.kinematics.objects.ObjectDetector`."""

LEROBOT = "lerobot:"
"""Prefix of the name of a LeRobot type, those of its plug-ins among them: always real."""

DRIVERS = "strands_robots.drivers."
"""Prefix of the modules of this package's own drivers."""

PLUG_INS = PlugIns("robot", ("so100", "so101", "rover", "so100_follower", "so101_follower", "reachy_mini"))
"""Robots of other packages; each is a callable that takes keyword options and returns a robot."""

_DEVICE = ("connect", "disconnect", "get_observation", "send_action")
"""Methods of LeRobot's robot interface, by which a device is known."""

NO_TOOL = (
    "A robot is no agent tool, and nothing to iterate over: serve it, or give Robot mesh=True, and give the agent "
    "robot_mesh (from strands_robots.tools import robot_mesh)."
)

NO_SUCH_MODEL = "NO_SUCH_MODEL"
"""Error code for a simulated robot whose model is unknown or cannot be loaded."""


class Networked:
    """Network identity and mesh peer that :func:`Robot` adds to a robot's class."""

    peer_id: str | None = None
    mesh: Any = None
    """The robot's native mesh peer, or None."""

    cell: str | None = None
    """The cell that the robot is in, for stops of one cell; None asks ``STRANDS_CELL``."""

    tags: tuple[str, ...] | None = None
    """Tags by which callers choose robots; None asks ``STRANDS_TAGS``."""

    of_package = False
    """True for a robot of another package, which may move anything."""

    def run(self, **options: Any) -> StopVerdict:
        """Serve this robot on Device Connect until SIGINT or SIGTERM; see :func:`run`."""
        return run(self, **{"peer_id": self.peer_id, "cell": self.cell, "tags": self.tags, **options})

    def cleanup(self) -> Any:
        """Leave the mesh, then halt the robot and free everything."""
        peer, self.mesh = self.mesh, None
        if peer is not None:
            peer.stop()
        own = getattr(super(), "cleanup", None)
        return own() if callable(own) else behind_contract(self).halt("cleanup").envelope()


class Former:
    """Answers to programs for strands-robots 0.5, behind what a robot has itself."""

    def __call__(self, *args: Any, **options: Any) -> NoReturn:
        raise TypeError(NO_TOOL)

    def __iter__(self) -> NoReturn:
        # Strands looks for tools in what it can iterate over, and only logs what it cannot use.
        raise TypeError(NO_TOOL)

    def __getattr__(self, name: str) -> Any:
        instead = METHODS.get(name)
        if instead is None:
            # Refuses as ever; for a property that failed by its own error.
            return object.__getattribute__(self, name)
        raise AttributeError(f"{name} of a robot is not in this release: {instead}.")


def Robot(  # the factory reads as the class it stands for
    name: str = "so100",
    mode: str = "sim",
    *,
    tool_name: str | None = None,
    peer_id: str | None = None,
    mesh: bool | None = None,
    cell: str | None = None,
    tags: Collection[str] | str | None = None,
    **options: Any,
) -> Any:
    """Make a running robot.

    Args:
        name: in simulation a model: ``so100``, ``so101``, ``rover``, the path of an MJCF or URDF file, or a
            ``robot_descriptions`` name. Real: a LeRobot robot type, such as ``so100_follower`` or ``so100``, or
            ``reachy_mini``. ``lerobot:NAME`` is a LeRobot type in any mode, of its plug-ins too. Or a robot of
            another package, by its entry point (:mod:`strands_robots.plug_ins`).
        mode: ``sim`` (MuJoCo, moving in real time) or ``real`` (a LeRobot device, connected without calibration). A
            robot of another package gets it as its option ``mode`` where it has one.
        tool_name: its name on a network; the robot's name by default.
        peer_id: its id on the networks.
        mesh: True joins the native mesh now, False never; None asks ``STRANDS_MESH``.
        cell: the cell that it is in, for stops of one cell; None asks ``STRANDS_CELL``, "" is none.
        tags: by which callers choose robots, such as ``("mobile", "lab-2")``; None asks ``STRANDS_TAGS``.
        options: ``sim``: arguments of ``Simulation`` (``timestep``, ``gravity``, ``realtime``), ``scene``
            (``tabletop``: a table with a red cube and a plate), and ``tip``, the site or body of the model that
            motions place. ``real``:
            ``control_hz``, ``joint_ranges``, ``stop_level``, ``rest_pose``, ``model``, ``speed_limit``, ``detector``
            (an object with ``detect(frames)``, see ``kinematics.objects``), and every other one goes to the
            LeRobot configuration of the robot, such as ``port="/dev/ttyACM0"`` and ``id="left"``, with ``cameras`` as
            dictionaries and ``calibration`` (a file or its content; LeRobot's file of the id by default).
            ``reachy_mini``: ``host`` (by default searched on the local network) and the arguments of
            ``ReachyDriver``. Another package's: those of its callable, and for a device with LeRobot's robot
            interface those of ``real``.

    Raises:
        ValidationError: an unknown name (the message lists similar ones) or an option outside its domain.
        MissingExtraError: the [sim] or [lerobot] extra, or that of the mesh, is not installed.
        ConnectionError: a real robot could not be connected.
    """
    settings.warn_of_unread()
    kind = choice("mode", mode, ("sim", "real"))
    if mesh is not None and not isinstance(mesh, bool):
        raise ValidationError(f"mesh must be true, false or None, not {shown(mesh)}.")
    if peer_id is not None:
        valid_peer_id("peer_id", peer_id)
    if cell is not None:
        own_cell(cell)
    stated = None if tags is None else own_tags(tags)
    plug_in = PLUG_INS.get(name)
    lerobot = isinstance(name, str) and name.startswith(LEROBOT)
    if plug_in is not None:
        robot = _of_package(plug_in, kind, tool_name, options)
    elif kind == "real" or lerobot:
        robot = _real(name.removeprefix(LEROBOT), tool_name, options)
    else:
        robot = _simulated(name, tool_name, options)
    robot.peer_id, robot.cell, robot.tags = peer_id, cell, stated
    if mesh or (mesh is None and mesh_env_request()):
        try:
            hardware = kind == "real" or lerobot or plug_in is not None
            robot.mesh = _join_mesh(robot, peer_id, "robot" if hardware else "sim")
        except BaseException:
            robot.cleanup()
            raise
    return robot


def counts_as_hardware(name: str) -> bool:
    """Return True for a robot that is real hardware in any mode; nothing is imported.

    A robot of another package may move anything, so it needs the operator's approval in its own simulation, too. Its
    ``module:NAME`` is the same robot.
    """
    ours = name == "reachy_mini" or name.startswith((LEROBOT, DRIVERS))
    return ours or PLUG_INS.get(name) is not None or PLUG_INS.makes(name)


def run(
    robot: Any,
    *,
    peer_id: str | None = None,
    until: threading.Event | None = None,
    mesh: bool | None = None,
    **network: Any,
) -> StopVerdict:
    """Serve ``robot`` until SIGINT, SIGTERM or ``until``, then halt it and leave.

    It is served on Device Connect; without a network in arguments or environment on this machine alone. Outside the
    main thread there are no signals, so ``until`` is needed.

    Args:
        robot: any robot that ``init_device_connect`` accepts.
        peer_id: its id, without dots; made from its name by default.
        until: ends the serving as a signal does.
        mesh: True joins the native mesh besides, under the same id; None asks ``STRANDS_MESH``. A robot that
            :func:`Robot` has joined stays as it is.
        network: other arguments of ``init_device_connect``, such as ``messaging_url``, ``cell``, ``tags``
            and ``allow_insecure``.

    Returns:
        The verdict of the halt.

    Raises:
        DuplicateDeviceError: another device of this id is served.
    """
    from strands_robots import device_connect  # noqa: PLC0415 - the network is loaded when it is used
    from strands_robots.device_connect.backends.config import usual_link  # noqa: PLC0415

    if peer_id is not None:
        own_device_id("peer_id", peer_id)
    if not {"messaging_url", "messaging_backend", "link"} & network.keys():
        network["link"] = usual_link(network.get("tenant"))
    # The halt of a stranger takes and answers what it likes, and may hang.
    body: Any = robot if has_gate(robot) and callable(getattr(robot, "halt", None)) else behind_contract(robot)
    verdict: StopVerdict = StopVerdict()
    # A user who waits for Ctrl-C reads the terminal, whatever the program does about logging.
    report: Callable[[str], None] = partial(print, file=sys.stderr, flush=True) if until is None else logger.info
    joins = getattr(robot, "mesh", None) is None and (mesh or (mesh is None and mesh_env_request() is True))
    with device_connect.StopSignal() if until is None else nullcontext(until) as stop:
        try:
            runtime = device_connect.init_device_connect_sync(robot, peer_id=peer_id, **network)
        except device_connect.DuplicateDeviceError as exc:
            # Its last line says it all: without the frames of the loop that brought it up.
            raise device_connect.DuplicateDeviceError(str(exc)) from None
        peer = None
        report(f"Serving {runtime.device_id}; Ctrl-C stops the robot first.")
        try:
            peer = _join_mesh(robot, runtime.device_id, "robot", network) if joins else None
            stop.wait()
        finally:
            free = put_away(body)
            verdict = body.halt("run ended")
            summary = text_of(verdict.envelope())
            if verdict.stopped is True:
                report(summary)
            else:
                logger.critical("%s", summary)
            if verdict.settling:
                # On the network, so that a stop still reaches it.
                report(body.wait_settled())
            if peer is not None:
                peer.close()
            device_connect.stop_device_connect(runtime)
            free()
    return verdict


def _simulated(name: str, tool_name: str | None, options: dict[str, Any]) -> Any:
    try:
        from strands_robots.simulation import Simulation, furnish  # noqa: PLC0415 - loads MuJoCo
    except MissingExtraError as exc:
        if name in PLUG_INS.built_in:
            raise
        raise MissingExtraError(f"There is no robot {shown(name)} of an installed package. {exc}") from exc

    label, scene, tip = _label(name), options.pop("scene", None), options.pop("tip", "")
    simulation = _construct(_networked(Simulation), tool_name=tool_name or label, **options)
    answer = simulation.add_robot(label, model=name, tip=tip)
    if is_error(answer):
        simulation.cleanup()
        installed = PLUG_INS.names()
        known = f" Robots of other packages: {', '.join(installed)}." if installed else ""
        raise ValidationError(f"{answer['reason']}{known}", NO_SUCH_MODEL)
    if scene is not None:
        try:
            furnish(simulation, scene)
        except ValidationError:
            simulation.cleanup()
            raise
    return simulation


def _of_package(plug_in: PlugIn, mode: str, tool_name: str | None, options: dict[str, Any]) -> Any:
    """Make a robot of another package: a device of LeRobot's kind, or an object."""
    factory = plug_in.load()
    if takes(factory, "mode"):
        options["mode"] = mode
    # What the package does not take itself is for the robot that its device is made to.
    own = {key: options.pop(key) for key in (*HARDWARE_OPTIONS, DETECTOR) if key in options and not takes(factory, key)}
    body = plug_in.make(**options)
    if all(callable(getattr(body, each, None)) for each in _DEVICE) and not callable(getattr(body, "start_task", None)):
        return _of_device(plug_in.name, body, tool_name, own)
    if own:
        raise ValidationError(f"{plug_in} has no option {', '.join(own)}.")
    if isinstance(body, Networked):
        raise ValidationError(f"{plug_in} must make a new robot at each call, and has made this one before.")
    try:
        body.__class__ = _networked(body.__class__, of_package=True)
        body.peer_id = None
    except (TypeError, AttributeError) as exc:  # of C, with slots, or frozen
        raise ValidationError(f"{plug_in} must make an object of a class of its own, not {shown(body)}.") from exc
    named = tool_name or ("" if getattr(body, "tool_name_str", None) else _label(plug_in.name))
    if named:
        body.tool_name_str = named
    return body


def _real(name: str, tool_name: str | None, options: dict[str, Any]) -> Any:
    if name == "reachy_mini":
        return _reachy(tool_name, options)
    from strands_robots.hardware.lerobot_device import make_device  # noqa: PLC0415 - real hardware only

    own = {key: options.pop(key) for key in (*HARDWARE_OPTIONS, DETECTOR) if key in options}
    return _of_device(name, make_device(name, options), tool_name, own)


def _of_device(name: str, device: Any, tool_name: str | None, own: dict[str, Any]) -> Any:
    """Make a connected robot of a device that has LeRobot's robot interface."""
    from strands_robots.hardware import HardwareRobot  # noqa: PLC0415 - real hardware only

    detector = own.pop(DETECTOR, None)
    if detector is not None and not callable(getattr(detector, "detect", None)):
        raise ValidationError(f"detector must have detect(frames), which {shown(detector)} has not.")
    robot = _construct(_networked(HardwareRobot), device, tool_name=tool_name or _label(name), **own)
    try:
        robot.connect()
    except Exception as exc:
        raise ConnectionError(f"{name} could not be connected: {' '.join(str(exc).split())}") from exc
    robot.detector = detector
    if own.get("model") is not None:
        try:
            robot.arm()
        except BaseException:
            # It would be refused with the first motion; whoever named the model is here now.
            robot.cleanup()
            raise
    return robot


def _reachy(tool_name: str | None, options: dict[str, Any]) -> Any:
    from strands_robots.drivers.reachy import ReachyDriver, make_reachy  # noqa: PLC0415 - as above

    robot = _construct(make_reachy, driver=_networked(ReachyDriver), **options)
    robot.tool_name_str = tool_name or robot.tool_name_str
    # The connection is made when the daemon appears.
    robot.connection.start()
    return robot


@cache
def _networked(robot_class: type[Any], *, of_package: bool = False) -> type[Any]:
    return type("Robot", (Networked, robot_class, Former), {"__doc__": robot_class.__doc__, "of_package": of_package})


def _construct(factory: Callable[..., Any], *args: Any, **options: Any) -> Any:
    try:
        return factory(*args, **options)
    except TypeError as exc:
        unknown = re.search(r"unexpected keyword argument '(\w+)'", str(exc))
        if unknown and unknown[1] in options:
            raise ValidationError(f"This robot has no option {unknown[1]}.") from exc
        raise ValidationError(f"Robot cannot be made with {', '.join(options)}: {exc}.") from exc


def _label(name: object) -> str:
    if not isinstance(name, str | Path) or not str(name).strip():
        raise ValidationError(f"name must be a robot's name or the path of its model, not {shown(name)}.")
    stem = Path(name).stem if "/" in str(name) or Path(name).suffix in (".xml", ".mjcf", ".urdf") else str(name)
    return re.sub(r"[^A-Za-z0-9_-]+", "-", stem)[:100].strip("-_") or "robot"


def _join_mesh(robot: Any, peer_id: str | None, peer_type: str, stated: Mapping[str, Any] | None = None) -> Any:
    from strands_robots.mesh import init_mesh  # noqa: PLC0415 - the mesh is loaded when it is used

    given = stated or {}
    cell = given.get("cell", getattr(robot, "cell", None))
    # What a foreign robot calls tags need be none: the mesh reads the robot's own as Device Connect does.
    mesh = init_mesh(robot, peer_id=peer_id, peer_type=peer_type, cell=cell, tags=given.get("tags"))
    if mesh is not None and hasattr(robot, "input_sink"):
        from strands_robots.mesh.input import MeshInputSink  # noqa: PLC0415 - as above

        robot.input_sink = MeshInputSink(mesh)
    return mesh
