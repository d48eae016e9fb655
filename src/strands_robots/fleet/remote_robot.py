"""Robot on another machine, of Device Connect or of the mesh.

A :class:`RemoteRobot` has the contract of a robot here: verbs with descriptions, state, features, events, halt. What
comes over the wire is data: it is bounded, and every text of it is marked as the robot's words.
"""

from __future__ import annotations

import base64
import inspect
import io
import logging
import re
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from keyword import iskeyword
from typing import TYPE_CHECKING, Any, Self

from strands_robots.envelope import Envelope, is_error
from strands_robots.errors import (
    ControlError,
    NoAnswerError,
    NoSuchRobotError,
    RefusalError,
    RobotError,
    UnknownVerbError,
)
from strands_robots.fleet.adapter import STOP_S, FoundRobot, NetworkAdapter
from strands_robots.fleet.far_lead import FarLead
from strands_robots.fleet.networks import STILL, Networks
from strands_robots.fleet.reports import EventFeed, refusal_of
from strands_robots.safety.stopping import StopVerdict
from strands_robots.serving.advertised import (
    PYTHON_TYPES,
    READS,
    RESUMES,
    STOPS,
    AdvertisedParameter,
    AdvertisedVerb,
    RobotDescription,
)
from strands_robots.serving.verbs import LEASE_ID
from strands_robots.utils import (
    DURATION_MAX_S,
    START_S,
    WAIT_S,
    near,
    number,
    optional_module,
    plain_value,
    shown,
    text,
)

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

logger = logging.getLogger(__name__)

MARK = "(as the robot describes it)"


def python_name(name: str) -> str:
    """Return a verb's name on the wire as Python spells it: ``moveTo``, ``move_to``."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", "_", name).lower()


def signature(verb: AdvertisedVerb) -> inspect.Signature:
    """Return the signature of a verb as a method, required parameters first."""
    named = [each for each in verb.parameters if not iskeyword(each.name)]
    rows = [_parameter(each) for each in sorted(named, key=lambda each: not each.required)]
    return inspect.Signature(rows, return_annotation=dict)


def docstring(verb: AdvertisedVerb, note: str = "") -> str:
    """Return the docstring of a verb as a method, marked as the robot's words."""
    lines = [verb.purpose or verb.name]
    if verb.parameters:
        lines += ["", "Args:", *(f"    {each.name}: {_meaning(each)}" for each in verb.parameters)]
    return "\n".join([*lines, "", *filter(None, [note]), MARK])


def _parameter(parameter: AdvertisedParameter) -> inspect.Parameter:
    empty = inspect.Parameter.empty
    return inspect.Parameter(
        parameter.name,
        inspect.Parameter.POSITIONAL_OR_KEYWORD,
        default=empty if parameter.required else parameter.schema.get("default"),
        annotation=PYTHON_TYPES.get(parameter.type, empty),
    )


def _meaning(parameter: AdvertisedParameter) -> str:
    """Return the line of one parameter: meaning, unit, domain."""
    unit = f"in {parameter.unit}" if parameter.unit else ""
    choices = f"one of {', '.join(map(shown, parameter.choices))}" if parameter.choices else ""
    said = (" ".join(parameter.meaning.split()), unit, parameter.bounds, choices)
    return "; ".join(filter(None, said)) or "(not described)"


RENEWALS = 3
"""Renewals in the time of a lease."""

RENEWED_S = 5.0
"""Seconds at most in which a renewal or the release has to be answered."""

Call = Callable[[str, Mapping[str, Any], float], Envelope]
"""Calls a verb of the robot with arguments within a time; raises :class:`RefusalError`."""


class HeldLease:
    """A lease that is renewed until :meth:`release`.

    Args:
        robot: its id, for the log.
        call: calls the robot.
        lease_id: the secret that the robot gave.
        ttl_s: seconds after which the robot ends the lease of a silent holder.
    """

    def __init__(self, robot: str, call: Call, lease_id: str, ttl_s: float) -> None:
        self.lease_id = lease_id
        self._robot, self._call, self._ttl_s = robot, call, ttl_s
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._renew, name=f"fleet-lease {robot}", daemon=True)
        self._thread.start()

    def release(self) -> None:
        """Free the robot for others; a lease that is not released ends by itself."""
        self._over.set()
        try:
            self._call("releaseControl", {"lease_id": self.lease_id}, min(RENEWED_S, self._ttl_s))
        except RefusalError as exc:
            logger.warning("%s: its control lease was not released and ends by itself: %s", self._robot, exc)
        self._thread.join(RENEWED_S)

    def _renew(self) -> None:
        pause = self._ttl_s / RENEWALS
        while not self._over.wait(pause):
            try:
                self._call("renewControl", {"lease_id": self.lease_id}, min(RENEWED_S, pause))
            except NoAnswerError as exc:
                logger.debug("%s: a renewal is tried again: %s", self._robot, exc)
            except ControlError as exc:
                # The next motion carries the lease all the same: the robot's refusal says who holds it.
                logger.warning("%s: its control lease is lost: %s", self._robot, exc)
                return
            except RefusalError as exc:
                logger.warning("%s: its control lease could not be renewed: %s", self._robot, exc)


class SharedLease:
    """Lease that all blocks of one robot share; the last block releases it."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._held: HeldLease | None = None
        self._blocks = 0

    @property
    def lease_id(self) -> str:
        """The secret of the lease that is held now; empty without one."""
        held = self._held
        return "" if held is None else held.lease_id

    @contextmanager
    def block(self, acquire: Callable[[], HeldLease]) -> Iterator[None]:
        """Hold the lease for the block, acquired by ``acquire`` where none is held."""
        with self._lock:
            if self._held is None:
                self._held = acquire()
            self._blocks += 1
        try:
            yield
        finally:
            # A block that begins meanwhile waits for the release, so that it is not refused for our own lease.
            with self._lock:
                self._blocks -= 1
                held = self._held
                if held is not None and not self._blocks:
                    self._held = None
                    held.release()


PIXELS_MAX = 4096 * 4096
ROBOTS_MAX = 1000

ROBOT_NAME = "robot_name"
"""Argument that names one robot of a world."""


@dataclass(frozen=True, slots=True)
class _Known:
    """Verbs of a robot as it described them once, with their names in Python."""

    description: RobotDescription
    names: Mapping[str, str]
    methods: dict[str, Callable[..., dict[str, Any]]] = field(default_factory=dict)

    @classmethod
    def of(cls, description: RobotDescription) -> Self:
        """Name the verbs that a method can have."""
        names: dict[str, list[str]] = {}
        for wire in description.verbs:
            names.setdefault(python_name(wire), []).append(wire)
        return cls(
            description,
            {
                name: wires[0]
                for name, wires in names.items()
                if len(wires) == 1 and name not in _RESERVED and name[0] != "_"
            },
        )


class RemoteRobot:
    """A robot on another machine. Its verbs are methods::

        arm = fleet["arm-1"]
        arm.move_to(x=0.25, y=0.0, z=0.1)     # the robot's moveTo; help(arm.move_to) describes it
        arm.call("moveTo", x=0.25, y=0.0, z=0.1, timeout=60.0)
        with arm.control():                   # no other caller moves it meanwhile
            arm.pick("cube")
        arm.halt()                            # a StopVerdict; never raises

    A verb's name is that on the wire in snake_case. A verb that has the name of a member of this class, one that
    begins with an underscore, and two verbs that give one name are reachable by :meth:`call` alone.

    A device that is not ours (a bare ``DeviceDriver`` with ``@rpc``) is a RemoteRobot too. It may have no lockout, no
    control lease and no stop: :attr:`has_lockout`, :attr:`has_lease` and :attr:`has_stop` say so, and its ``repr``.

    Args:
        found: the robot as its network announces it.
        network: the network that reads and calls go to.
        networks: all on which a robot may have this id; ``network`` alone by default.
    """

    def __init__(self, found: FoundRobot, network: NetworkAdapter, networks: Networks | None = None) -> None:
        self._found, self._network = found, network
        self._networks = networks or Networks([network])
        self._one: Mapping[str, str] = {}
        self._described_as: _Known | None = None
        self._lease = SharedLease()
        self._of_world: dict[str, RobotOfWorld] = {}

    @property
    def id(self) -> str:
        """Its id on the network."""
        return self._found.id

    @property
    def address(self) -> str:
        """The id that its network knows it by; of a robot of a world the world's."""
        return self.id

    @property
    def type(self) -> str:
        """Its type as it states it, such as ``strands_robot``."""
        return self._found.type

    @property
    def model(self) -> str:
        """The model that it states; may be empty."""
        return self._found.model

    @property
    def tags(self) -> tuple[str, ...]:
        """Tags that it states, by which :meth:`Fleet.where` finds it."""
        return self._found.tags

    @property
    def network(self) -> str:
        """``device_connect`` or ``mesh``."""
        return self._network.name

    @property
    def verbs(self) -> Mapping[str, AdvertisedVerb]:
        """Its verbs by their names on the wire."""
        return self._described.verbs

    @property
    def left_out(self) -> tuple[str, ...]:
        """Parts of its description that are out of bounds and left out."""
        return self._described.left_out

    @property
    def has_stop(self) -> bool:
        """True where it has a stop."""
        return "stop" not in self._described.lacking

    @property
    def has_lockout(self) -> bool:
        """True where an emergency stop locks it until the operator's resume."""
        return "lockout" not in self._described.lacking

    @property
    def has_lease(self) -> bool:
        """True where :meth:`control` keeps other callers from moving it."""
        return "lease" not in self._described.lacking

    def call(self, verb: str, /, *, timeout: float | None = None, **arguments: Any) -> dict[str, Any]:
        """Call a verb by its name on the wire and return the robot's answer.

        Args:
            verb: such as ``moveTo``.
            timeout: seconds to wait for the answer, above 0; by default as long as the verb may take.
            arguments: checked by the robot.

        Raises:
            RefusalError: the robot refused it, failed or did not answer; the subclass says which.
        """
        if timeout is not None:
            timeout = number("timeout", timeout, above=0, high=DURATION_MAX_S + 60)
        return self._call(text("verb", verb), arguments, timeout)

    def status(self) -> dict[str, Any]:
        """Return what it is doing, its lockouts and its holder."""
        return self._call(self._network.reads["status"], {}, None)

    def state(self) -> dict[str, Any]:
        """Return its measured state."""
        reads = self._network.reads
        # A world on Device Connect tells its joints with its status.
        known = not self.verbs or reads["state"] in self.verbs
        return self._call(reads["state"] if known else reads["status"], {}, None)

    def features(self) -> dict[str, Any]:
        """Return its observations and actions with their units."""
        return self._call(self._network.reads["features"], {}, None)

    def events(self, timeout: float | None = None) -> EventFeed:
        """Return its events from now on, as an iterator and context manager.

        Args:
            timeout: seconds without an event after which the iteration ends; None waits for ever.
        """
        return EventFeed(self.address, self._network, timeout)

    def picture(self, camera: str = "", width: int = 640, height: int = 480) -> NDArray[np.uint8]:
        """Return a picture of a camera as an array of height x width x 3, RGB, 0 to 255.

        Args:
            camera: as ``listCameras`` has it; empty for the first.
            width: largest width in pixels.
            height: largest height in pixels.

        Raises:
            RefusalError: the robot has no camera, or its answer is no picture.
            MissingExtraError: Pillow or numpy is not installed.
        """
        answer = self._call("getPicture", {"camera": camera, "width": width, "height": height}, None)
        try:
            return _decoded(answer.get("jpeg"))
        except (ValueError, OSError, SyntaxError) as exc:
            raise RobotError(f"Its answer is no picture: {exc}", robot=self.id, verb="getPicture") from exc

    def halt(self, reason: str = "") -> StopVerdict:
        """Stop what moves it, without a lockout; never raises.

        Every robot of this id is stopped, on each network that has one.

        Args:
            reason: for this side's log.

        Returns:
            The verdict; *unknown* by name where the robot did not answer or has no stop.
        """
        logger.debug("%s is halted: %s", self.id, reason)
        return self._networks.halt(self.address, **self._one)

    @contextmanager
    def control(self, ttl_s: float = 60.0) -> Iterator[Self]:
        """Hold the robot for the block: motions of other callers are refused.

        The lease is renewed in the background and released at the end, also after an exception. If this process dies,
        the robot halts when ``ttl_s`` seconds are over. Blocks of this object that overlap or nest, on any thread,
        share one lease with the ``ttl_s`` of the first; it is released at the end of the last one.

        Raises:
            ControlError: another caller holds it.
            UnknownVerbError: it has no control lease.
        """
        seconds = number("ttl_s", ttl_s, above=0)
        with self._lease.block(lambda: self._acquired(seconds)):
            yield self

    def lead(self, leader: str = "leader", **options: Any) -> FarLead:
        """Lead the robot from here; a context manager, at whose end it holds.

        Args:
            leader: name of the leader, as others see it.
            options: of the verb ``lead``: ``guide`` (positions or differences), ``policy_provider``, ``instruction``,
                ``duration`` (s), ``max_speed`` (ranges a second), ``stale_ms``.

        Raises:
            RefusalError: the robot refused it; another leader is named.
        """
        opened = self._call("lead", {"leader": leader, **options}, None)
        return FarLead(self.id, self._call, opened, policy=bool(options.get("policy_provider")))

    @property
    def robots(self) -> Mapping[str, RobotOfWorld]:
        """The robots of a world by name, each a robot like any other; else none.

        Raises:
            RefusalError: the world does not answer.
        """
        if not any(ROBOT_NAME in each.by_name for each in self.verbs.values()):
            return {}
        named = self.status().get("robots")
        names = [each for each in named if isinstance(each, str)] if isinstance(named, Mapping | list) else []
        for name in names[:ROBOTS_MAX]:
            self._of_world.setdefault(name, RobotOfWorld(self, name))
        return {name: self._of_world[name] for name in names[:ROBOTS_MAX]}

    def __getattr__(self, name: str) -> Callable[..., dict[str, Any]]:
        # Copying and pickling ask for underscore names before there is a description.
        if name.startswith("_"):
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        known = self._known
        if name not in known.names:
            # It may have come back with other verbs.
            known = self._describe(anew=True, must=True)
        wire = known.names.get(name)
        if wire is None:
            raise self._unknown(name)
        if name not in known.methods:
            known.methods[name] = self._method(name, known.description.verbs[wire])
        return known.methods[name]

    def __dir__(self) -> list[str]:
        return sorted({*object.__dir__(self), *self._names})

    def __repr__(self) -> str:
        kind = self.model or self.type
        known = self._described_as is not None or self._network.announces_verbs
        lacking = self._lacking() if known else ""
        return f"<RemoteRobot {self.id} ({', '.join(filter(None, (kind, self.network, lacking)))})>"

    @property
    def _described(self) -> RobotDescription:
        return self._known.description

    @property
    def _names(self) -> Mapping[str, str]:
        return self._known.names

    @property
    def _known(self) -> _Known:
        return self._described_as or self._describe()

    def _describe(self, *, anew: bool = False, must: bool = False) -> _Known:
        """Ask the network for the robot's verbs, and name the methods.

        Args:
            anew: ask the robot itself; what is known stays where it does not answer.
            must: raise :class:`NoSuchRobotError` or :class:`NoAnswerError` for a robot that is gone.
        """
        try:
            functions = self._network.describe(self.address, anew=anew)
        except RefusalError as exc:
            if must and isinstance(exc, NoSuchRobotError | NoAnswerError):
                raise
            logger.warning("%s: its verbs cannot be read: %s", self.id, exc)
            return self._described_as or _Known.of(RobotDescription.of(self._found.functions))
        known = _Known.of(RobotDescription.of(self._found.functions if functions is None else functions))
        self._described_as = known
        return known

    def _sent(self, verb: str, arguments: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return the arguments as they are sent."""
        del verb
        return arguments

    def rediscovered(self, found: FoundRobot, network: NetworkAdapter) -> None:
        """Take what a new discovery found; its verbs are read again when they are used."""
        self._found, self._described_as = found, None
        self._network = self._networks.decided(self.address) or network

    def _acquired(self, ttl_s: float) -> HeldLease:
        if not self.has_lease:
            raise UnknownVerbError("It has no control lease", robot=self.id, verb="acquireControl")
        answer = self._call("acquireControl", {"ttl_s": ttl_s}, None)
        lease_id = answer.get("lease_id")
        if not isinstance(lease_id, str) or not lease_id:
            raise RobotError("It gave no lease_id", robot=self.id, verb="acquireControl", envelope=answer)
        return HeldLease(self.id, self._call, lease_id, ttl_s)

    def _lacking(self) -> str:
        return ", ".join(f"no {name}" for name in self._described.lacking)

    def _method(self, name: str, verb: AdvertisedVerb) -> Callable[..., dict[str, Any]]:
        stated = signature(verb)
        positional = tuple(stated.parameters)

        def method(*values: Any, **arguments: Any) -> dict[str, Any]:
            if values:
                arguments = _named(name, positional, values, arguments)
            return self._call(verb.name, arguments, None)

        lacking = self._lacking()
        method.__name__ = name
        method.__qualname__ = f"{type(self).__name__}.{name}"
        method.__doc__ = docstring(verb, f"This robot has {lacking}." if lacking else "")
        vars(method)["__signature__"] = stated
        return method

    def _call(self, verb: str, arguments: Mapping[str, Any], timeout: float | None) -> dict[str, Any]:
        arguments = {name: plain_value(value) for name, value in arguments.items()}
        if verb in STOPS and len(self._networks.stated) > 1:
            # It waits for no description, and goes to every robot of this id.
            stop = {**arguments, **self._one}
            return self._taken(verb, self._networks.call(self.address, verb, stop, timeout or STOP_S))
        description = self._described.verbs.get(verb)
        kind = ("read" if verb in READS else "motion") if description is None else description.kind
        moves = kind == "motion" and verb not in STILL
        if moves:
            if self._decide(verb):
                description = self._described.verbs.get(verb)
            lease_id = self._lease.lease_id
            # A verb that is not described may be a motion, which the robot refuses without the lease.
            takes_it = description is None or LEASE_ID in description.leases
            if lease_id and takes_it and LEASE_ID not in arguments:
                arguments = {**arguments, LEASE_ID: lease_id}
        if timeout is None:
            timeout = _patience(description, arguments)
        try:
            return self._taken(verb, self._answer(verb, self._sent(verb, arguments), timeout, moves=moves))
        except UnknownVerbError:
            self._describe(anew=True)
            raise self._unknown(verb) from None

    def _answer(self, verb: str, arguments: Mapping[str, Any], timeout: float, *, moves: bool) -> Envelope:
        try:
            return self._network.call(self.address, verb, arguments, timeout)
        except NoSuchRobotError:
            other = self._networks.instead(self.address, verb, self._network, moves=moves)
            if other is None:
                raise
        self._network, self._described_as = other, None
        return other.call(self.address, verb, arguments, timeout)

    def _taken(self, verb: str, answer: Envelope) -> Envelope:
        if is_error(answer):
            raise refusal_of(self.id, verb, answer)
        return answer

    def _decide(self, verb: str) -> bool:
        """Use the network that motions go to; True where it is another one."""
        if len(self._networks.bearers(self.address)) < 2 and not self._networks.enrolled_on_absent(self.address):
            return False
        network = self._networks.of(self.address, verb, moves=True)
        if network is self._network:
            return False
        self._network, self._described_as = network, None
        return True

    def _unknown(self, verb: str) -> UnknownVerbError:
        named = tuple(dict.fromkeys((*self.verbs, *self._names)))
        called = ", ".join(name for name in self.verbs if python_name(name) == verb)
        remedy = f"Reach it by call(): {called}." if called else near(verb, named).strip()
        return UnknownVerbError(f"It has no verb {verb[:100]}", robot=self.id, verb=verb, remedy=remedy)


class RobotOfWorld(RemoteRobot):
    """One robot of a remote world, which is a robot like any other.

    Args:
        world: that has it.
        name: in the world.
    """

    def __init__(self, world: RemoteRobot, name: str) -> None:
        self._world, self._name = world, name
        super().__init__(
            FoundRobot(f"{world.id}/{name}", world.type, name, world.tags), world._network, world._networks
        )
        self._whole: _Known | None = None
        self._one = {ROBOT_NAME: name}

    @property
    def address(self) -> str:
        """The id of its world."""
        return self._world.id

    def state(self) -> dict[str, Any]:
        """Return its measured state: ``joints`` by name."""
        answer = super().state()
        robots = answer.pop("robots", None)
        joints = robots.get(self._name) if isinstance(robots, Mapping) else None
        return {**answer, "joints": joints if isinstance(joints, Mapping) else {}}

    def features(self) -> dict[str, Any]:
        """Return its observations and actions with their units."""
        answer = super().features()
        robots = answer.pop("robots", None)
        own = robots.get(self._name) if isinstance(robots, Mapping) else None
        return {**answer, **(own if isinstance(own, Mapping) else {})}

    @property
    def _known(self) -> _Known:
        current = self._described_as is not None and self._world._known is self._whole
        return (self._described_as if current else None) or self._describe()

    def _describe(self, *, anew: bool = False, must: bool = False) -> _Known:
        whole = self._world._describe(anew=True, must=must) if anew else self._world._known
        verbs = {name: verb for name, each in whole.description.verbs.items() if (verb := _of_one(each))}
        self._described_as, self._whole = _Known.of(replace(whole.description, verbs=verbs)), whole
        return self._described_as

    @property
    def _network(self) -> NetworkAdapter:
        return self._world._network

    @_network.setter
    def _network(self, network: NetworkAdapter) -> None:
        if network is not self._world._network:
            self._world._network, self._world._described_as = network, None

    def _sent(self, verb: str, arguments: Mapping[str, Any]) -> Mapping[str, Any]:
        whole = self._world.verbs.get(verb)
        # A motion that is not described is never sent without the robot's name: it would move another one.
        named = verb not in READS | RESUMES if whole is None else ROBOT_NAME in whole.by_name
        return {**arguments, **self._one} if named else arguments


def _of_one(verb: AdvertisedVerb) -> AdvertisedVerb | None:
    """Return a verb of a world as one robot has it; None for one of all robots."""
    if ROBOT_NAME not in verb.by_name and verb.kind == "motion":
        return None
    return replace(verb, parameters=tuple(each for each in verb.parameters if each.name != ROBOT_NAME))


_RESERVED = frozenset(dir(RemoteRobot))
"""Names of members, which no verb of a robot takes."""


def _patience(verb: AdvertisedVerb | None, arguments: Mapping[str, Any]) -> float:
    """Return the seconds in which a verb has to answer."""
    if verb is None:
        return START_S
    lasts, duration, waits = verb.lasts_s, arguments.get("duration"), verb.name == "wait" or "wait" in verb.by_name
    if lasts and isinstance(duration, int | float) and 0 < duration <= DURATION_MAX_S:
        lasts = max(lasts, float(duration))
    return START_S + (WAIT_S if waits else 0.0) + lasts


def _named(verb: str, positional: Sequence[str], values: Sequence[Any], arguments: Mapping[str, Any]) -> dict[str, Any]:
    """Return the arguments by name."""
    if len(values) > len(positional):
        raise TypeError(f"{verb}() takes {len(positional)} positional arguments but {len(values)} were given")
    given = dict(zip(positional, values, strict=False))
    twice = given.keys() & arguments.keys()
    if twice:
        raise TypeError(f"{verb}() got multiple values for argument {', '.join(sorted(twice))}")
    return {**given, **arguments}


def _decoded(jpeg: object) -> NDArray[np.uint8]:
    """Return a base64 JPEG as pixels; raise ValueError or OSError for anything else."""
    images = optional_module("PIL.Image", what="picture", extra="sim")
    numpy = optional_module("numpy", what="picture", extra="sim")
    if not isinstance(jpeg, str):
        raise ValueError("there is no jpeg in it")  # noqa: TRY004 - the answer's value, not the caller's type
    try:
        opened = images.open(io.BytesIO(base64.b64decode(jpeg, validate=True)), formats=("JPEG",))
    except images.DecompressionBombError as exc:
        raise ValueError(str(exc)) from exc
    with opened as image:
        # The header is read before the pixels, so that a small file cannot ask for gigabytes.
        if image.width * image.height > PIXELS_MAX:
            raise ValueError(f"it has {image.width} x {image.height} pixels")
        pixels: NDArray[np.uint8] = numpy.asarray(image.convert("RGB"))
    return pixels
