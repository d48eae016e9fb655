"""What the device drivers share: the door that every RPC passes, and the stop.

An RPC of a subclass asks :meth:`RobotDriver.move` or :meth:`RobotDriver.read` and returns what they return: an
envelope, always. Robot verbs run on threads (:mod:`.workers`), never on the event loop; ``stop`` has threads that
no motion and no read can take.
"""

from __future__ import annotations

import inspect
import logging
from collections.abc import Awaitable, Callable, Mapping
from concurrent.futures import TimeoutError as FutureTimeoutError
from functools import cached_property
from typing import Any

from device_connect_edge.drivers.decorators import get_rpc_source_device

from strands_robots import settings
from strands_robots.contract import TaskRobot, WorldRobot
from strands_robots.device_connect._compat import emit, on, rpc
from strands_robots.device_connect.live_driver import READ_DEADLINE_S, LiveDriver
from strands_robots.device_connect.safety_seat import SafetySeat
from strands_robots.device_connect.workers import Lane, LaneFullError
from strands_robots.envelope import Envelope, error, is_error, jsonable, success
from strands_robots.safety.approval import Approval
from strands_robots.safety.authorization import Authorization
from strands_robots.safety.gate import Asked, MotionRefused
from strands_robots.safety.stopping import StopVerdict, explain, grade
from strands_robots.utils import ValidationError, shown

logger = logging.getLogger(__name__)

MOVE_DEADLINE_S = 10.0
"""Seconds in which a robot has to have started a motion; after that its permit is void."""

MOVES_AT_ONCE, STOPS_AT_ONCE = 2, 8

Call = Callable[[], object]


class RobotDriver(LiveDriver):
    """A robot as a device. Subclasses name the verbs and read the state.

    Args:
        robot: what is driven, behind its contract.
        hardware: True where a motion needs the operator's approval besides the caller's authorization.
    """

    def __init__(
        self,
        robot: TaskRobot | WorldRobot,
        *,
        hardware: bool,
        authorization: Authorization | None = None,
        approval: Approval | None = None,
    ) -> None:
        super().__init__(robot)
        name = robot.tool_name_str
        self.hardware = hardware
        self.authorization = authorization or Authorization(hardware=hardware, robot=name)
        self.approval = approval or Approval()
        self.seat: SafetySeat | None = None
        self.moves = Lane("motion", MOVES_AT_ONCE)
        self.stops = Lane("stop", STOPS_AT_ONCE)
        self.alarms = Lane("emergency stop", STOPS_AT_ONCE)

    # The door.

    async def invoke(self, function_name: str, /, **params: Any) -> Any:
        """Call an RPC by name; parameters that it does not have, or lacks, are refused by name."""
        signature = self._signatures.get(function_name)
        if signature is not None:
            known = {name: value for name, value in params.items() if name != "source_device"}
            try:
                signature.bind(**known)
            except TypeError as exc:
                has = ", ".join(signature.parameters) or "no parameters"
                return error(f"{function_name} takes {has}: {exc}.")
        return await super().invoke(function_name, **params)

    @cached_property
    def _signatures(self) -> dict[str, inspect.Signature]:
        methods = {definition.name: getattr(self, definition.name) for definition in self.functions}
        return {name: inspect.signature(method) for name, method in methods.items()}

    async def move(self, verb: str, prepare: Callable[[], Call]) -> Envelope:
        """Start a motion: authorization, arguments, lockout, the operator's approval, then the robot's verb.

        Args:
            verb: the RPC's name, which is what callers and operators are allowed.
            prepare: checks the arguments (raising :class:`ValidationError`) and gives the call.
        """
        caller = get_rpc_source_device()
        return await self._guarded(verb, lambda: self._moved(verb, prepare, caller))

    async def read(self, verb: str, call: Call) -> Envelope:
        """Answer a question, to every caller."""
        return await self._guarded(verb, lambda: self.reads.run(call, READ_DEADLINE_S))

    async def _moved(self, verb: str, prepare: Callable[[], Call], caller: object) -> object:
        refusal = self.authorization.motion(caller, verb)
        if refusal is not None:
            return error(refusal)
        call, asked = prepare(), self.robot.gate.asked()
        try:
            answer = await self.moves.run(lambda: self._start(verb, call, asked), MOVE_DEADLINE_S)
        except TimeoutError:
            # This call alone: to revoke the gate without a halt would leave what moves with its last command.
            asked.give_up()
            raise
        logger.info("%s: %s by caller %s (self-declared).", self.peer_id, verb, shown(caller))
        self.changed.set()
        return answer

    def _start(self, verb: str, call: Call, asked: Asked) -> object:
        """The part of a motion that may touch a disk or a device: lockout, approval, the robot's verb."""
        with self.robot.gate.asked_at(asked):
            return self._permitted(verb, call)

    def _permitted(self, verb: str, call: Call) -> object:
        locked = self.robot.gate.refusal(verb)
        if locked is not None:
            return locked
        if not self.hardware:
            return call()
        claim = self.approval.claim(verb, self.peer_id)
        if claim is None:
            return error(Approval.refusal(verb, self.peer_id))
        answer: object = None
        try:
            answer = call()
        finally:
            if answer is None or is_error(answer):
                claim.give_back()
            else:
                claim.spend()
        return answer

    async def _guarded(self, verb: str, work: Callable[[], Awaitable[object]]) -> Envelope:
        try:
            return _enveloped(verb, await work())
        except ValidationError as exc:
            return error(str(exc))
        except MotionRefused as exc:
            return _enveloped(verb, exc.envelope)
        except LaneFullError as exc:
            return error(f"{verb} refused: the robot has not yet answered earlier {exc} calls; try again later.")
        except TimeoutError:
            return error(f"The robot did not answer {verb} in time; what it may still start is void.")
        except Exception:
            logger.exception("%s: %s failed.", self.peer_id, verb)
            return error(f"{verb} failed inside the device; its log has the details.")

    # The stop.

    @rpc(labels={"direction": "write", "safety": "critical"})
    async def resume(self, assertion: dict[str, Any]) -> dict[str, Any]:
        """Free the robot of one emergency stop, at the word of the operator's key; nothing starts to move by it.

        Args:
            assertion: What the operator's resume key signed: v, epoch, targets, t, nonce and sig
        """
        seat = self.seat
        if seat is None:
            return error("resume rejected")
        return await self._guarded("resume", lambda: self.alarms.run(lambda: seat.resume(assertion), READ_DEADLINE_S))

    def with_safety(self, call: Call) -> Call:
        """``call`` whose answer also says what holds the robot and how the dead-man check-in stands."""

        def read() -> object:
            answer = call()
            if self.seat is None or not isinstance(answer, dict):
                return answer
            return {**answer, **self.seat.facts()}

        return read

    def halt(self, reason: str) -> StopVerdict:
        """Halt every motion source and wait for the verdict, at most the halt deadline. Callable from any thread."""
        within = settings.number("STRANDS_HALT_DEADLINE_S")
        try:
            answer: object = self.stops.start(lambda: self.robot.halt(reason)).result(within)
        except FutureTimeoutError:
            return StopVerdict(not_stopped={self.peer_id: f"no answer in {within:g} s"}, elapsed_ms=within * 1000)
        except LaneFullError:
            self.robot.gate.revoke()
            return StopVerdict(unknown={self.peer_id: "earlier stops are still unanswered"})
        except Exception as exc:  # noqa: BLE001 - whatever a halt raises is graded
            answer = exc
        return answer if isinstance(answer, StopVerdict) else _graded(self.peer_id, answer)

    async def halted(self, work: Callable[[], Envelope]) -> Envelope:
        """Run a stop on threads of its own; the answer to the caller, which is never a refusal to try."""
        within = 2 * settings.number("STRANDS_HALT_DEADLINE_S") + 1.0
        try:
            return _enveloped("stop", await self.alarms.run(work, within))
        except LaneFullError:
            self.robot.gate.revoke()
            return error(
                "Earlier stops of this robot are still unanswered; its motion permits are revoked.", stopped=None
            )
        except TimeoutError:
            return error(f"The robot did not answer the stop within {within:g} s.", stopped=False)
        except Exception as exc:
            logger.exception("%s: stop failed.", self.peer_id)
            return error(f"stop failed inside the device: {type(exc).__name__}; its log has the details.", stopped=None)

    def handle_estop(self, device_id: object, payload: object) -> StopVerdict | None:
        """Act on an emergency stop: halt, and log what did not. None when it does not count. Any thread."""
        if device_id == self.peer_id:
            return None
        refusal = self.authorization.estop(device_id)
        if refusal is not None:
            logger.warning("%s: emergency stop ignored: %s.", self.peer_id, refusal)
            return None
        why = payload.get("reason", "") if isinstance(payload, Mapping) else ""
        verdict = self.halt(f"emergency stop of {device_id}: {shown(why)}")
        told = verdict.envelope()
        if verdict.stopped:
            logger.warning(
                "%s: halted by emergency stop of %s: %s", self.peer_id, device_id, told["content"][0]["text"]
            )
        else:
            logger.critical("%s: EMERGENCY STOP of %s DID NOT STOP IT: %s", self.peer_id, device_id, told.get("reason"))
        return verdict

    @emit(labels={"safety": "critical"})
    async def emergencyStop(self, reason: str = "") -> None:
        """This device calls for an emergency stop.

        Args:
            reason: Why
        """

    @on(event_name="emergencyStop")
    async def onEmergencyStop(self, device_id: str, event_name: str, payload: dict[str, Any]) -> None:
        """Halt every motion source on the emergency stop of an allowed source."""
        await self.on_estop(device_id, payload)

    async def on_estop(self, device_id: object, payload: object) -> None:
        """The second road of an emergency stop: into the safety plane, or, off the network, off the loop at least."""
        if device_id == self.peer_id:
            return
        if self.seat is not None:
            self.seat.second_road(device_id, payload)
            return
        try:
            self.alarms.start(lambda: self.handle_estop(device_id, payload))
        except LaneFullError:
            if self.authorization.estop(device_id) is None:
                self.robot.gate.revoke()
                logger.critical("%s: emergency stop of %s while earlier stops are unanswered.", self.peer_id, device_id)


def _graded(name: str, answer: object) -> StopVerdict:
    outcome = grade(answer)
    if outcome.stopped:
        return StopVerdict(halted=(name,))
    where = {name: explain(answer)}
    return StopVerdict(unknown=where) if outcome.stopped is None else StopVerdict(not_stopped=where)


def _enveloped(verb: str, answer: object) -> Envelope:
    """A robot's answer as an envelope that JSON can carry."""
    if not isinstance(answer, Mapping):
        return error(f"The robot answered {verb} with {shown(answer)}, which nobody here understands.")
    plain: Envelope = jsonable(answer)
    if plain.get("status") in ("success", "error"):
        return plain
    return success(f"{verb} answered.", **{k: v for k, v in plain.items() if k not in ("content", "status")})
