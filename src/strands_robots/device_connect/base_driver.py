"""Robot as a device: RPC methods made from its verbs, its stop, its state.

The driver is a codec: it turns an RPC into a :class:`~strands_robots.serving.pipeline.Command`, and the pipeline's
answer into an envelope that JSON can carry. Robot calls run on threads, never on the event loop.
"""

from __future__ import annotations

import asyncio
import inspect
import json
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, ClassVar, TypeVar
from weakref import WeakKeyDictionary

from device_connect_edge.drivers.decorators import get_rpc_source_device
from device_connect_edge.types import DeviceIdentity, DeviceStatus, EventDef, FunctionDef

from strands_robots import settings
from strands_robots.adapted import is_value, warn_endless
from strands_robots.contract import Haltable, Robot, RolloutEvent, Unsubscribe, observe
from strands_robots.device_connect._compat import CollectedOnce, Runtime, describe_anew, emit, observed, on, rpc
from strands_robots.device_connect.command_records import CommandRecords
from strands_robots.device_connect.device_stops import DeviceStops, SafetyRegistration, stops_of
from strands_robots.device_connect.presence import lock_stated
from strands_robots.device_connect.telemetry import (
    READ_DEADLINE_S,
    Activity,
    RolloutPump,
    StateReports,
    sweep,
)
from strands_robots.envelope import Envelope, RefusalReason, Refused, error, is_error, jsonable, success
from strands_robots.safety.authorization import ANONYMOUS, Approval, Authorization, caller_name
from strands_robots.safety.gate import MotionRequest
from strands_robots.safety.stop_executor import stop_executor
from strands_robots.safety.stop_link import ESTOP
from strands_robots.safety.stopping import StopVerdict
from strands_robots.serving.control import ControlChange
from strands_robots.serving.control_leases import control_facts
from strands_robots.serving.offered_verbs import Offers, own_verbs
from strands_robots.serving.pipeline import Command, Pipeline, Result, busy
from strands_robots.serving.policy_arguments import profile_list
from strands_robots.serving.stop_arguments import noted, stop_of
from strands_robots.serving.stops import stop_within
from strands_robots.serving.verbs import OF_ALLOWED_CALLERS, Arguments, Kind, Verb, described, labels_of, text_of
from strands_robots.serving.workers import ShareFullError, called, loop_future
from strands_robots.stop_log import stop_logger
from strands_robots.utils import START_S, WAIT_S, ValidationError, shown, text
from strands_robots.verb_parameters import REQUIRED

logger = stop_logger(__name__)

T = TypeVar("T")

_FUNCTIONS: WeakKeyDictionary[type, tuple[FunctionDef, ...]] = WeakKeyDictionary()
_EVENTS: WeakKeyDictionary[type, tuple[EventDef, ...]] = WeakKeyDictionary()
_DESCRIBED: WeakKeyDictionary[type, dict[tuple[str, frozenset[str]], str]] = WeakKeyDictionary()


def rpc_method(verb: Verb) -> Callable[..., Any]:
    """Make the RPC method of a verb from the verb's description."""

    async def method(self: RobotDriver, *values: object, **named: object) -> dict[str, Any]:
        arguments = {**dict(zip(verb.by_name, values, strict=False)), **named}
        caller = get_rpc_source_device()
        answer: Envelope = await self.invoke(verb.name, False, **arguments, source_device=caller)
        return answer

    empty = inspect.Parameter.empty
    method.__name__ = verb.name
    method.__qualname__ = f"RobotDriver.{verb.name}"
    method.__doc__ = text_of(verb)
    method.__annotations__ = {**{each.name: each.type for each in verb.parameters}, "return": dict[str, Any]}
    parameters = [
        inspect.Parameter(
            each.name,
            inspect.Parameter.POSITIONAL_OR_KEYWORD,
            default=empty if each.default is REQUIRED else each.default,
            annotation=each.type,
        )
        for each in verb.parameters
    ]
    itself = inspect.Parameter("self", inspect.Parameter.POSITIONAL_OR_KEYWORD)
    vars(method)["__signature__"] = inspect.Signature([itself, *parameters], return_annotation=dict[str, Any])
    return rpc(labels=labels_of(verb))(method)


def stated_type(robot: object, usual: str) -> str:
    """Return the ``device_type`` that a robot states for itself, else the usual one.

    Raises:
        ValidationError: it states a value that is no short text.
    """
    stated = getattr(robot, "device_type", None)
    # A test double has every attribute, and states nothing by it.
    return usual if not is_value(stated) else text("device_type", stated, longest=100)


def enveloped(verb: str, answer: object) -> Envelope:
    """Return a robot's answer as an envelope that JSON can carry."""
    if not isinstance(answer, Mapping):
        return error(f"The robot answered {verb} with an unknown result shape: {shown(answer)}.")
    plain: Envelope = jsonable(answer)
    if plain.get("status") in ("success", "error"):
        return plain
    return success(f"{verb} answered.", **{k: v for k, v in plain.items() if k not in ("content", "status")})


class RobotDriver(CollectedOnce):
    """Robot as a device; subclasses name its verbs and events and read its state.

    Args:
        robot: what is driven, behind its contract.
        hardware: True where a motion needs the operator's approval besides the caller's authorization.
    """

    cell: str | None = None
    """The cell that the robot is in, "" for none; None asks the robot, then ``STRANDS_CELL``."""

    noun: ClassVar[str] = "Robot"
    """Begins the description of the device."""

    verbs: ClassVar[Mapping[str, Verb]] = {}
    """The verbs of the device, by name; each becomes an RPC method. An instance serves its robot's own besides."""

    own_verbs: Mapping[str, Verb] = {}
    """The verbs that the robot itself declares, by name."""

    built_verbs: ClassVar[Mapping[str, Verb]] = {}
    """Those of :attr:`verbs` whose RPC method was made from them and not overridden."""

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        built = {name: verb for name, verb in cls.built_verbs.items() if name not in vars(cls)}
        for name, verb in cls.verbs.items():
            if not hasattr(cls, name) or built.get(name, verb) is not verb:
                setattr(cls, name, rpc_method(verb))
                built[name] = verb
        cls.built_verbs = built

    def __init__(
        self,
        robot: Robot,
        *,
        hardware: bool,
        authorization: Authorization | None = None,
        approval: Approval | None = None,
    ) -> None:
        super().__init__()
        self.robot = robot
        self.own_verbs = own_verbs(robot)
        self._described: dict[tuple[str, frozenset[str]], str] = {}
        self.offers = Offers(robot, self.built_verbs)
        self.hardware = hardware
        self.authorization = authorization or Authorization(hardware=hardware, robot=robot.tool_name_str)
        self.registration: SafetyRegistration | None = None
        self.stops, self.reports = DeviceStops(self), StateReports(self)
        self.pipeline = Pipeline.of(
            robot,
            lambda: self.peer_id,
            hardware=hardware,
            authorize=self.authorize,
            approval=approval or Approval(),
            own={"resume": self.stops.resume, "getStatus": self._status},
        )
        self.runtime: Any = None
        self.policy_provider = ""
        """Of the last motion that was asked for, for a robot that tells no events."""
        self._records = CommandRecords()
        self._watchers: list[asyncio.Task[None]] = []
        self._unsubscribe: Unsubscribe | None = None
        self._end_control: Callable[[], None] = lambda: None
        self._end_refusals: Callable[[], None] = lambda: None

    # Commands.

    async def invoke(self, function_name: str, observable: bool = True, /, **params: Any) -> Any:
        """Serve one call of a verb. Never raises for what the caller or the robot did.

        The framework's spans and log lines are left out while nothing takes them.

        Args:
            function_name: the RPC's name.
            observable: False in a call that the framework's own wrapper makes.
            params: arguments, and ``source_device``, the caller's declared name.
        """
        own = self.own_verbs.get(function_name)
        verb = own or self.verbs.get(function_name)
        if verb is not None and verb.kind is Kind.STOP and function_name in self.built_verbs:
            caller = params.pop("source_device", None)
            answer = await self._stop(verb, params, caller)
            self._records.stopped(self.peer_id, caller, answer)
            return answer
        ours = own is not None or (function_name in self.built_verbs and not (observable and observed(self)))
        if verb is None or not ours:
            if verb is not None:
                caller = {name: params.pop(name) for name in ("source_device",) if name in params}
                params = {**verb.read(params), **caller}
            problem = verb and verb.unfit(params.keys() - {"source_device"})
            return error(problem) if problem else await super().invoke(function_name, **params)
        caller = params.pop("source_device", None)
        moves = verb.kind is Kind.MOTION
        request = self.pipeline.pending.arrive(params.get("robot_name")) if moves else None
        command = Command(verb, params, caller, request)
        answered, hand_over = loop_future()
        try:
            self.pipeline.shares.by_name[verb.share].submit(partial(self.pipeline.serve, command, hand_over))
            # Not wait_for: in Python 3.11 it forgets a cancellation that comes together with the answer.
            within_s = (START_S if moves else READ_DEADLINE_S) + (verb.lasts_s or WAIT_S if verb.lasts else 0.0)
            async with asyncio.timeout(within_s):
                result: Result = await answered
        except ShareFullError:
            result = busy(command)
        except TimeoutError:
            # This command alone: to revoke the gate without a halt would leave what moves with its last command.
            if request is not None:
                request.give_up()
            return error(f"The robot did not answer {verb.name} in time; what it may still start is void.")
        answer = enveloped(verb.name, result.result)
        if verb.kind in OF_ALLOWED_CALLERS and is_error(answer):
            self._records.refused(self.peer_id, command, result.refusal, answer)
        if moves and result.refusal is None:
            logger.info("%s: %s by caller %s (self-declared).", self.peer_id, verb.name, shown(caller))
            self.reports.wake()
        return answer

    def authorize(self, command: Command, arguments: Arguments) -> tuple[str, ...]:
        """Refuse a caller or a policy that is not allowed; return the caller's name."""
        if command.verb.kind not in OF_ALLOWED_CALLERS:
            return ()
        provider = arguments.get("policy_provider", "")
        self.policy_provider = provider or self.policy_provider
        refusal = self.authorization.motion(command.caller, command.verb.name, provider)
        if refusal is not None:
            raise Refused(RefusalReason.CALLER, refusal)
        return (caller_name(command.caller) or ANONYMOUS,)

    def _status(self, arguments: Arguments, request: MotionRequest | None) -> object:
        """The robot's status with its lockouts, the dead-man check-in and who holds it."""
        answer = self.verbs["getStatus"].call(self.robot, arguments)()
        if not isinstance(answer, dict):
            return answer
        lockouts = self.stops.facts(arguments.get("nonce", ""))
        running = self.robot.gate.under_way.name
        return {**answer, **lockouts, **control_facts(self.pipeline.leases), **({"verb": running} if running else {})}

    # Stops.

    def stop_target(self, robot_name: str = "") -> Haltable:
        """Return what ``stop`` halts: the named robot of a world, or all that moves.

        Raises:
            ValidationError: the world has no robot of this name.
        """
        return self.robot

    def stop_envelope(self, verdict: StopVerdict) -> Envelope:
        """Return the answer to ``stop`` for a verdict."""
        return verdict.envelope()

    async def _stop(self, verb: Verb, given: Mapping[str, Any], caller: object) -> Envelope:
        arguments, ignored = verb.readable(given)
        name = arguments.get("robot_name", "")
        self.pipeline.pending.void(name)
        try:
            target = self.stop_target(name)
        except ValidationError as unknown:
            return enveloped("stop", self.stop_envelope(StopVerdict(not_stopped={name: str(unknown)})))
        reason = stop_of(verb.name, caller_name(caller))
        return noted(await self.stop_answer(reason, target, name), ignored)

    async def stop_answer(self, reason: str, target: Haltable | None = None, name: str = "") -> Envelope:
        """Halt and answer within the halt deadline, for any caller."""
        target = target or self.stop_target()
        halting = stop_executor().submit(target, name or self.peer_id, reason, within=stop_within(target))
        verdict = await asyncio.wrap_future(halting)
        return enveloped("stop", self.stop_envelope(verdict))

    @emit(labels={"safety": "critical"})
    async def emergencyStop(self, reason: str = "") -> None:
        """This device locks and halts, and calls for an emergency stop of all others.

        Args:
            reason: Why
        """

    @on(event_name="emergencyStop")
    async def onEmergencyStop(self, device_id: str, event_name: str, payload: dict[str, Any]) -> None:
        """Halt every motion source on the emergency stop of an allowed source."""
        await self.on_estop(device_id, payload)

    @property
    def _stops_are_shared(self) -> bool:
        """True where one subscription receives the stops for all devices of the link."""
        ours = self.registration is not None and isinstance(self.runtime, Runtime)
        return ours and type(self).onEmergencyStop is RobotDriver.onEmergencyStop

    def _collect_event_subscriptions(self) -> list[dict[str, Any]]:
        """Return the subscriptions of this device alone."""
        found = super()._collect_event_subscriptions()
        return [each for each in found if not (self._stops_are_shared and each["handler"] == self.onEmergencyStop)]

    async def on_estop(self, device_id: object, payload: object, raw: bytes | int | None = None) -> None:
        """Act on an emergency stop that the runtime received.

        ``raw`` is its message, or the number of bytes of one that is too long to be read.
        """
        self.stops.receive(device_id, payload, raw)

    # Control.

    @emit(labels={"safety": "informational"})
    async def controlTaken(self, robot: str, holder: str, epoch: int, reason: str = "") -> None:
        """A human took the robot from its holder.

        Args:
            robot: the robot of a world, or this one
            holder: who has it now
            epoch: number of the lease
            reason: why
        """

    @emit(labels={"safety": "informational"})
    async def controlExpired(self, robot: str, holder: str, epoch: int) -> None:
        """The holder was silent for too long; what it moved is halted.

        Args:
            robot: the robot of a world, or this one
            holder: who had it
            epoch: number of the lease
        """

    @emit(labels={"safety": "informational"})
    async def motionRefused(self, verb: str, reason: str) -> None:
        """A motion was refused while the robot is locked; at most five a second are told.

        Args:
            verb: that was asked for
            reason: who locked it
        """

    def _on_refused(self, verb: str, why: str) -> None:
        self._emit_from_thread("motionRefused", {"verb": verb, "reason": why})

    def _on_control(self, change: ControlChange) -> None:
        facts: dict[str, Any] = {"robot": change.robot, "holder": change.holder, "epoch": change.epoch}
        if change.event == "taken":
            event, facts = "controlTaken", {**facts, "reason": change.reason}
        elif change.event == "expired":
            event = "controlExpired"
        else:
            return
        self._emit_from_thread(event, facts)

    def _emit_from_thread(self, event: str, facts: dict[str, Any]) -> None:
        try:
            self.runtime.emit_from_thread(event, facts)
        except RuntimeError as exc:
            logger.warning("%s: %s was not told: %s", self.peer_id, event, exc)

    # State.

    def glance(self) -> Activity:
        """Ask the robot for its activity. May block: runs on a thread."""
        raise NotImplementedError

    async def tell(self, activity: Activity) -> None:
        """Emit the state events of ``activity``."""
        raise NotImplementedError

    async def tell_rollout(self, event: RolloutEvent) -> None:
        """Emit the events that belong to ``event``."""
        raise NotImplementedError

    @property
    def identity(self) -> DeviceIdentity:
        """Identity of this device; ``model`` is the robot's own name."""
        model = self.robot.tool_name_str
        return DeviceIdentity(
            device_type=self.device_type,
            manufacturer="strands-robots",
            model=model,
            description=f"{self.noun} {model}{profile_list()}",
        )

    @property
    def functions(self) -> list[FunctionDef]:
        """Return what the robot can be called for now, read once for each class."""
        if type(self) not in _FUNCTIONS:
            _FUNCTIONS[type(self)] = tuple(super().functions)
        missing = self.built_verbs.keys() - self.offers.names
        own = [FunctionDef(**described(verb)) for verb in self.own_verbs.values()]
        return [*(each for each in _FUNCTIONS[type(self)] if each.name not in missing), *own]

    def _get_functions(self) -> dict[str, Callable[..., Any]]:
        functions = super()._get_functions()
        for name, own in self.own_verbs.items():
            if name not in functions:
                functions[name] = partial(rpc_method(own), self)
        return functions

    @property
    def events(self) -> list[EventDef]:
        """The events that can be received; read off a class once, too."""
        if type(self) not in _EVENTS:
            _EVENTS[type(self)] = tuple(super().events)
        return list(_EVENTS[type(self)])

    def described(self) -> str:
        """Return the capabilities as JSON, encoded once for a class, labels and verbs.

        Raises:
            TypeError, ValueError: JSON cannot carry them.
        """
        key = json.dumps(self.labels, allow_nan=False), self.offers.names
        # A robot with verbs of its own is described like no other of its class.
        known = self._described if self.own_verbs else _DESCRIBED.setdefault(type(self), {})
        if key not in known:
            known[key] = json.dumps(self.capabilities.model_dump(), allow_nan=False)
        return known[key]

    @property
    def status(self) -> DeviceStatus:
        """Live availability: busy (score 1.0) while something runs, else idle (0.0)."""
        return DeviceStatus(**self.status_of(self.reports.present))

    def status_of(self, activity: Activity) -> dict[str, Any]:
        """Return the fields of the status for an activity."""
        return {
            "availability": "busy" if activity.busy else "idle",
            "busy_score": 1.0 if activity.busy else 0.0,
            "error_state": activity.fault or None,
        }

    @property
    def lives(self) -> bool:
        """False while the robot cannot be read."""
        return not self.reports.activity.fault

    @property
    def locked_out(self) -> bool | None:
        """True while an emergency stop locks it; None where that is not known."""
        return self.stops.locked

    def heartbeat(self) -> dict[str, Any]:
        """Return what every heartbeat carries besides the id and the time."""
        describe_anew(self.runtime, self)
        activity = self.reports.activity
        return {**self.status_of(activity), **lock_stated(self), "state": jsonable(activity.facts)}

    def set_device(self, device: Any) -> None:
        """Learn the runtime, which has this robot's id on the network."""
        super().set_device(device)
        self.runtime = device

    @property
    def peer_id(self) -> str:
        """The device's id on the network; before it has one, the robot's own name."""
        return str(getattr(self.runtime, "device_id", "") or self.robot.tool_name_str)

    def set_event_callback(self, callback: Callable[[str, dict[str, Any]], Any]) -> None:
        """Emit through ``callback`` on the loop of this call, from any thread."""
        home = asyncio.get_running_loop()

        async def emit_at_home(name: str, payload: dict[str, Any]) -> None:
            clean = jsonable(payload)
            if name == ESTOP:
                self.stops.call_for(clean)
            if asyncio.get_running_loop() is home:
                await callback(name, clean)
            else:
                await asyncio.wrap_future(asyncio.run_coroutine_threadsafe(callback(name, clean), home))

        super().set_event_callback(emit_at_home)

    async def connect(self) -> None:
        """Start telling the state; the robot manages its own hardware connection."""
        if self.runtime is None or self._watchers:
            return
        await self.stops.register()
        # Before it is announced: a change from now on is told.
        describe_anew(self.runtime, self)
        opened = self.authorization.opened()
        if opened is not None:
            logger.warning("%s is real hardware, and callers that are not named may move it: %s.", self.peer_id, opened)
        warn_endless(self.robot, self.peer_id)
        if self._stops_are_shared:
            await stops_of(self.runtime.link).join(self)
        await self.reports.read()
        pump = RolloutPump(self.reports.on_rollout, settings.number("STRANDS_DC_STREAM_HZ"))
        subscribe = partial(observe, self.robot, pump.observe)
        self._unsubscribe = await called(self.pipeline.shares.read, subscribe, READ_DEADLINE_S)
        self._watchers = [asyncio.create_task(work) for work in (pump.run(), *self.watches())]
        sweep(settings.number("STRANDS_DC_STATE_HZ")).add(self.reports)
        if self.pipeline.leases is not None:
            self._end_control = self.pipeline.leases.observe(self._on_control)
        self._end_refusals = self.robot.gate.watch_refusals(self._on_refused)

    def watches(self) -> list[Any]:
        """Return the coroutines that run while the device is connected."""
        busy_hz = settings.number("STRANDS_DC_STATE_BUSY_HZ")
        idle_hz = settings.number("STRANDS_DC_STATE_HZ")
        return [self.reports.watch(self.reports.look, self.tell, self.same, busy_hz, idle_hz)]

    def same(self, one: Activity, other: Activity) -> bool:
        """Return True for two states of which the second one need not be told."""
        return one == other

    async def disconnect(self) -> None:
        """Stop telling the state; the robot manages its own shutdown."""
        watchers, self._watchers = self._watchers, []
        if self._stops_are_shared:
            await stops_of(self.runtime.link).leave(self)
        if watchers:
            sweep(settings.number("STRANDS_DC_STATE_HZ")).remove(self.reports)
        for watcher in watchers:
            watcher.cancel()
        await asyncio.gather(*watchers, return_exceptions=True)
        self.reports.end()
        self._end_control()
        self._end_refusals()
        unsubscribe, self._unsubscribe = self._unsubscribe, None
        if unsubscribe is not None:
            try:
                await called(self.pipeline.shares.read, unsubscribe, READ_DEADLINE_S)
            except Exception as exc:  # noqa: BLE001 - whatever a robot raises, its device leaves
                logger.warning("%s: its events could not be unsubscribed: %s", self.peer_id, exc)
        await self.stops.leave()
