"""Driving by hand: the page's control leases, and jogs that end by themselves.

A jog is a motion towards the end of an axis that is stopped when its button is released, when its page is hidden or
gone, and when no beat has come for 200 ms. Should this server die, the robot halts when the lease is over.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import time
from collections.abc import Callable, Collection, Coroutine, Mapping
from dataclasses import dataclass, field
from typing import Any

from strands_robots.dashboard.page_lead import PageLead, ShownPictures, caller
from strands_robots.dashboard.page_robots import PageRobot
from strands_robots.envelope import Envelope, error, is_error, success, text_of
from strands_robots.fleet.far_lead import FarLead
from strands_robots.policies.base import plain_numbers
from strands_robots.safety.resume import sign_take
from strands_robots.safety.stopping import grade
from strands_robots.serving.control import HUMAN
from strands_robots.serving.verbs import LEASE_ID
from strands_robots.utils import ValidationError, choice, joint_name, number, shown, text

BEAT_S = 0.2
"""Longest time without a beat of the page after which a jog is stopped."""

LEASE_S, RENEW_S = 1.0, 0.25
"""Time of the page's lease, after which the robot halts by itself, and between two renewals."""

ANSWER_S = 10.0
STOPS_MAX = 3
SETTLE_S = 0.5

DEGREES = (45.0, 20.0, 8.0, 3.0, 1.0)
METRES = (0.1, 0.04, 0.015, 0.005)
"""Lengths of one stretch of a jog, tried from the longest: the way of each is checked by the robot's planner."""

DRIVE_S = 20.0
DRIVEN = f"a drive ends after {DRIVE_S:g} s; press again to go on."
"""A base does not say whether its drive was halted meanwhile, so no second one follows by itself."""

DEGREES_OF = {"degrees": 1.0, "radians": math.degrees(1.0), "metres": 1.0}
"""Degrees in one unit of a joint, or metres of a slide."""

LINEAR_M_S, ANGULAR_RAD_S = 0.3, 0.8
"""Speed of a base at full jog speed."""

TIP_AXES = ("x", "y", "z")
KINDS = ("joint", "tip", "gripper", "base")

LEADER = "page"
TAKE_FIRST = "Take control of the robot first."

SendToPage = Callable[[dict[str, Any]], None]


@dataclass(frozen=True, slots=True)
class JogAxis:
    """Axis and direction of a jog, checked.

    Attributes:
        name: a joint, an axis of the tip, ``linear`` or ``angular``.
        direction: 1 or -1.
        speed: share of full speed.
        part: which robot of a world; empty for the first.
    """

    kind: str
    name: str
    direction: int
    speed: float
    part: str = ""

    @classmethod
    def of(cls, message: Mapping[str, Any]) -> JogAxis:
        """Read a page's message.

        Raises:
            ValidationError: naming the first field outside its domain.
        """
        kind = choice("kind", message.get("kind"), KINDS)
        name = text("axis", message.get("axis", ""), longest=128, empty=kind == "gripper")
        if kind == "tip":
            choice("axis", name, TIP_AXES)
        if kind == "base":
            choice("axis", name, ("linear", "angular"))
        direction = number("direction", message.get("direction"), low=-1, high=1)
        if direction not in (-1.0, 1.0):
            raise ValidationError(f"direction must be 1 or -1, not {shown(message.get('direction'))}.")
        speed = number("speed", message.get("speed", 0.3), above=0, high=1)
        part = text("part", message.get("part", ""), longest=128, empty=True)
        return cls(kind, name, int(direction), speed, part)

    def stretches(
        self, joints: Mapping[str, float], units: Mapping[str, str] | None = None
    ) -> list[tuple[str, dict[str, Any]]]:
        """Return the calls that move along the axis, from the longest stretch.

        Args:
            joints: positions, in degrees or for a slide in metres.
            units: of the robot's joints, as its features name them: ``metres`` is a slide.
        """
        common: dict[str, Any] = {"robot_name": self.part} if self.part else {}
        if self.kind == "base":
            linear = self.direction * self.speed * LINEAR_M_S if self.name == "linear" else 0.0
            angular = self.direction * self.speed * ANGULAR_RAD_S if self.name == "angular" else 0.0
            return [("drive", {"linear": linear, "angular": angular, "duration": DRIVE_S})]
        if self.kind == "gripper":
            return [("setGripper", {"opening": 1.0 if self.direction > 0 else 0.0, "wait": False, **common})]
        common |= {"speed": self.speed, "wait": False}
        if self.kind == "tip":
            return [("moveBy", {f"d{self.name}": self.direction * each, **common}) for each in METRES]
        # The page has the robot's own key, such as pan.pos, where getPose and moveJoints have the model's joint.
        name = next((each for each in joints if joint_name(each) == joint_name(self.name)), None)
        if name is None:
            raise ValidationError(f"axis must be one of {', '.join(joints)}, not {shown(self.name)}.")
        start = joints[name]
        lengths = METRES if (units or {}).get(self.name) == "metres" else DEGREES
        return [("moveJoints", {"joints": {name: start + self.direction * each}, **common}) for each in lengths]


@dataclass(slots=True)
class HeldRobot:
    """A robot that this page holds."""

    robot: PageRobot
    part: str
    lease_id: str
    renewing: asyncio.Task[None] | None = None
    jog: Jogging | None = None
    lead: PageLead | None = None
    lost: str = ""


@dataclass(slots=True)
class Jogging:
    """One jog: what it moves, its last beat, and whether it was released.

    Attributes:
        units: of the robot's joints, as its features name them.
    """

    axis: JogAxis
    units: Mapping[str, str] = field(default_factory=dict)
    heartbeat: float = field(default_factory=time.monotonic)
    released: asyncio.Event = field(default_factory=asyncio.Event)
    why: str = ""
    task: asyncio.Task[None] | None = None

    def release(self, why: str) -> None:
        """End the jog; the first reason counts."""
        if not self.released.is_set():
            self.why = why
            self.released.set()


class HandControl:
    """Robots that one page holds, its jogs, and its turns with a policy.

    Args:
        tell: sends a message to the page.
    """

    def __init__(self, tell: SendToPage) -> None:
        self._tell = tell
        self._held: dict[str, HeldRobot] = {}
        self._taking: set[str] = set()
        self._endings: set[asyncio.Future[object]] = set()
        self._gone = False

    def lease(self, key: str) -> dict[str, str]:
        """Return the lease as an argument of a motion; empty where the robot is not held."""
        held = self._held.get(key)
        return {LEASE_ID: held.lease_id} if held is not None else {}

    def holds(self, key: str) -> bool:
        """Return True for a robot that this page holds."""
        return key in self._held

    @property
    def held(self) -> Collection[str]:
        """Keys of the robots that this page holds."""
        return tuple(self._held)

    async def take(self, key: str, robot: PageRobot, *, part: str = "", signer: Any = None) -> Envelope:
        """Hold a robot: acquire it where it is free, else take it from its holder.

        Args:
            signer: the operator's key, where the robot asks for a signature.
        """
        if key in self._held or key in self._taking:
            return error(f"This page holds {robot.id} already.")
        self._taking.add(key)
        try:
            which = {"robot_name": part} if part else {}
            asked = {"kind": HUMAN, "ttl_s": LEASE_S, **which}
            answer = await robot.call("acquireControl", asked, ANSWER_S, moves=True)
            if is_error(answer) and answer.get("code") == "not_holder":
                answer = await self._displace(robot, which, signer)
            lease = answer.get(LEASE_ID)
            if is_error(answer) or not isinstance(lease, str):
                return answer if is_error(answer) else error(f"{robot.id} gave no lease.")
            held = HeldRobot(robot, part, lease)
            if self._gone:
                # Nobody is there to drive it, and nobody would ever give it back.
                await robot.call("releaseControl", self._lease_of(held), ANSWER_S)
                return error(f"The page has gone; {robot.id} was given back.")
            self._held[key] = held
            held.renewing = asyncio.create_task(self._renew(key, held))
        finally:
            self._taking.discard(key)
        fields = {name: value for name, value in answer.items() if name not in (LEASE_ID, "content")}
        return {**fields, "content": [{"text": _taken(answer)}]} if "taken_from" in answer else fields

    async def lead(self, key: str, policy: str, task: str, *, pictures: bool) -> Envelope:
        """Have a policy drive a held robot, from which a push takes over.

        Args:
            policy: its name.
            task: told to the policy.
            pictures: the page drives by pictures, whose age bounds its commands.
        """
        held = self._held.get(key)
        if held is None:
            return error(TAKE_FIRST)
        if held.lead is not None or held.jog is not None or key in self._taking:
            return error(f"This page moves {held.robot.id} already.")
        self._taking.add(key)
        try:
            asked = {"leader": LEADER, "guide": "differences", "policy_provider": policy, "instruction": task}
            asked |= self._lease_of(held)
            answer = await held.robot.call("lead", asked, ANSWER_S, moves=True)
            if is_error(answer):
                if not {"refused", "code"} & answer.keys():
                    # These are not the robot's words: it may have begun.
                    await held.robot.stop()
                return answer
            if self._held.get(key) is not held or "lead_id" not in answer:
                # The page has gone, or has lost control: nobody is there to lead it.
                await held.robot.stop()
                return error(f"{held.robot.id} is not held any more, and was stopped.")
            held.lead = PageLead(
                FarLead(held.robot.id, caller(held.robot), answer, policy=True),
                LeadTold(self, key, held),
                ShownPictures() if pictures else None,
            )
        finally:
            self._taking.discard(key)
        return success(f"The policy drives {held.robot.id}. A push takes over.")

    def give_back(self, key: str) -> str:
        """Leave a led robot to its policy; return why not, or ""."""
        held = self._held.get(key)
        if held is None or held.lead is None:
            return "This page does not lead the robot."
        held.lead.give_back()
        return ""

    async def end_lead(self, key: str) -> Envelope:
        """Stop a robot that this page leads, and end the lead."""
        held = self._held.get(key)
        if held is None or held.lead is None:
            return error("This page does not lead the robot.")
        return await self.ended(key, held, "")

    async def ended(self, key: str, held: HeldRobot, why: str) -> Envelope:
        """Stop a robot that this page leads, end the lead, and tell the page."""
        lead, held.lead = held.lead, None
        if lead is None:
            return error("This page does not lead the robot.")
        # The stop waits for nothing of the lead, and the robot holds where the stop is lost.
        lead.cease()
        self._taking.add(key)
        try:
            answer = await held.robot.stop()
            await lead.end()
        finally:
            self._taking.discard(key)
        self.tell_turn(key, "over", why, stopped=grade(answer).stopped, text=text_of(answer))
        return answer

    def cease(self, key: str, why: str) -> None:
        """End what the hand does at a robot that is being stopped; waits for nothing."""
        held = self._held.get(key)
        if held is None:
            return
        lead, held.lead = held.lead, None
        if lead is not None:
            # A push that is released sends where the robot stands; nothing is sent any more.
            lead.cease()
            self._keep(lead.end())
            if lead.pushes:
                self.tell_let_go(key, why)
            self.tell_turn(key, "over", why)
        self.release(key, why)

    def tell_turn(self, key: str, state: str, why: str, **more: Any) -> None:
        """Tell the page who drives a robot."""
        self._tell({"type": "turn", "key": key, "state": state, "why": why, **more})

    def tell_let_go(self, key: str, why: str) -> None:
        """Tell the page why a push has ended."""
        self._tell({"type": "let_go", "key": key, "why": why})

    def end_soon(self, key: str, held: HeldRobot, why: str) -> None:
        """Stop a robot that nobody leads any more."""
        self._keep(self.ended(key, held, why))

    def _keep(self, work: Coroutine[Any, Any, object]) -> None:
        task = asyncio.ensure_future(work)
        self._endings.add(task)
        task.add_done_callback(self._endings.discard)

    def pictures(self, key: str) -> ShownPictures | None:
        """Return the pictures by which the page leads a robot; None where it does not."""
        held = self._held.get(key)
        return held.lead.pictures if held is not None and held.lead is not None else None

    async def give(self, key: str) -> Envelope:
        """Stop what this page moves there, and give the robot back."""
        held = self._held.get(key)
        if held is None:
            return error("This page does not hold the robot.")
        if held.jog is not None:
            held.jog.release("control was given back")
            if held.jog.task is not None:
                await asyncio.wait([held.jog.task], timeout=ANSWER_S)
        if held.lead is not None:
            await self.ended(key, held, "control was given back")
        self._held.pop(key, None)
        if held.renewing is not None:
            held.renewing.cancel()
        return await held.robot.call("releaseControl", self._lease_of(held), ANSWER_S)

    def begin(self, key: str, message: Mapping[str, Any], units: Mapping[str, str] | None = None) -> str:
        """Begin a jog of a held robot; return the reason of a refusal, or ""."""
        held = self._held.get(key)
        if held is None:
            return TAKE_FIRST
        if held.jog is not None or key in self._taking:
            return "Another jog of this robot has not ended yet."
        try:
            axis = JogAxis.of(message)
        except ValidationError as refused:
            return str(refused)
        if held.lead is not None:
            if axis.kind != "joint":
                return "in turns with a policy the page leads joints alone."
            return held.lead.push(axis.name, axis.direction, axis.speed)
        jog = held.jog = Jogging(axis, units or {})
        jog.task = asyncio.create_task(self._jog(key, held, jog))
        return ""

    def alive(self, key: str) -> None:
        """Note that somebody looks at the page of a robot that it leads."""
        held = self._held.get(key)
        if held is not None and held.lead is not None:
            held.lead.alive()

    def beat(self, key: str) -> None:
        """Note that the button is still held down."""
        held = self._held.get(key)
        if held is not None and held.lead is not None:
            held.lead.beat()
        if held is not None and held.jog is not None:
            held.jog.heartbeat = time.monotonic()

    def release(self, key: str, why: str = "released") -> None:
        """End the jog or the push of a robot."""
        held = self._held.get(key)
        if held is not None and held.lead is not None:
            held.lead.release(why)
        if held is not None and held.jog is not None:
            held.jog.release(why)

    async def leave(self) -> None:
        """Halt each robot that is held and give it back: the page has gone."""
        self._gone = True
        held = list(self._held.items())
        for _, each in held:
            if each.jog is not None:
                each.jog.release("the page has gone")
        await asyncio.gather(*(self._leave(key, each) for key, each in held), return_exceptions=True)

    async def _leave(self, key: str, held: HeldRobot) -> None:
        if held.jog is None and held.lead is None:
            await held.robot.stop()
        await self.give(key)

    async def _displace(self, robot: PageRobot, which: dict[str, str], signer: Any) -> Envelope:
        before = await robot.call("getControl", which, ANSWER_S)
        if is_error(before):
            return before
        asked: dict[str, Any] = {"reason": "an operator took over on the page", **which}
        part, epoch = which.get("robot_name", ""), before.get("epoch")
        if signer is not None and isinstance(epoch, int):
            asked["assertion"] = sign_take(signer, f"{robot.id}/{part}" if part else robot.id, epoch)
        answer = await robot.call("takeControl", asked, ANSWER_S, moves=True)
        lease = answer.get(LEASE_ID)
        if is_error(answer) or not isinstance(lease, str):
            return answer
        # A lease that was taken lasts a minute; ours ends soon after this server.
        held = {LEASE_ID: lease, "kind": HUMAN, "ttl_s": LEASE_S, **which}
        acquired = await robot.call("acquireControl", held, ANSWER_S, moves=True)
        return {**acquired, "taken_from": str(before.get("holder", ""))[:128], "signed": signer is not None}

    async def _renew(self, key: str, held: HeldRobot) -> None:
        silent_since: float | None = None
        while True:
            await asyncio.sleep(RENEW_S)
            answer = await held.robot.call("renewControl", self._lease_of(held), LEASE_S)
            if not is_error(answer):
                silent_since = None
                continue
            silent_since = silent_since or time.monotonic()
            if answer.get("code") is None and time.monotonic() - silent_since < LEASE_S:
                continue
            held.lost = text_of(answer)
            if held.jog is not None:
                held.jog.release("control was lost")
            self._held.pop(key, None)
            self._tell({"type": "control", "key": key, "held": False, "text": held.lost})
            lead, held.lead = held.lead, None
            if lead is not None:
                # Another holder may move it now: it is not stopped here.
                await lead.end()
                self.tell_turn(key, "over", held.lost)
            return

    async def _jog(self, key: str, held: HeldRobot, jog: Jogging) -> None:
        watchdog = asyncio.create_task(_watch(jog))
        begun: list[asyncio.Task[Envelope]] = []
        problem = ""
        try:
            problem = await self._stretch(held, jog, begun)
        except ValidationError as refused:
            problem = str(refused)
        finally:
            watchdog.cancel()
            released = time.monotonic()
            # The page, or its session, may be gone: the stop goes on by itself.
            answer = await asyncio.shield(asyncio.ensure_future(_stopped(held, begun)))
            held.jog = None
            stopped = grade(answer).stopped
            self._tell(
                {
                    "type": "jogged",
                    "key": key,
                    "stopped": stopped,
                    "why": problem or jog.why,
                    "refused": bool(problem),
                    "text": "" if stopped else text_of(answer),
                    "ms": round((time.monotonic() - released) * 1000, 1),
                }
            )

    async def _stretch(self, held: HeldRobot, jog: Jogging, begun: list[asyncio.Task[Envelope]]) -> str:
        """Move until the release; return why it cannot go on, or ""."""
        while not jog.released.is_set():
            joints: Mapping[str, float] = {}
            if jog.axis.kind == "joint":
                pose = await self._until_release(held, jog, "getPose", {"robot_name": jog.axis.part})
                if pose is None:
                    return ""
                joints = pose["joints"] if isinstance(pose.get("joints"), Mapping) else {}
                if is_error(pose):
                    # A robot without a model has no pose, and may have joints.
                    state = await self._until_release(held, jog, "getState", {})
                    joints = stated_positions(state or {}, jog.units)
                    if not joints:
                        return "" if state is None else text_of(pose)
            problem = ""
            for verb, params in jog.axis.stretches(joints, jog.units):
                answer = await self._until_release(held, jog, verb, {**params, **self._lease_of(held)}, begun)
                if answer is None:
                    return ""
                problem = text_of(answer) if is_error(answer) else ""
                if not problem:
                    ended = await self._under_way(held, jog, answer)
                    if ended:
                        return ended
                    break
                # A motion that had begun was ended by somebody: a shorter one would start the robot again.
                if answer.get("code") is not None or "task_id" in answer:
                    return problem
            if problem:
                return problem
            if jog.axis.kind == "gripper":
                await jog.released.wait()
        return ""

    async def _under_way(self, held: HeldRobot, jog: Jogging, answer: Envelope) -> str:
        """Wait for the end of a stretch or the release; return why the jog ends, or "".

        Only a stretch that was completed is followed by another one: any other end may be a halt, a stop or a contact.
        """
        task_id = answer.get("task_id")
        if not isinstance(task_id, str):
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(jog.released.wait(), DRIVE_S)
            return "" if jog.released.is_set() or jog.axis.kind == "gripper" else DRIVEN
        params = {"task_id": task_id, "seconds": 5.0, **({"robot_name": jog.axis.part} if jog.axis.part else {})}
        while True:
            state = await self._until_release(held, jog, "wait", params)
            status = "" if state is None else str(state.get("task_status", "")).lower()
            if state is None or status == "completed":
                return ""
            if status != "running":
                return text_of(state) or f"the motion ended as {shown(status)}"

    async def _until_release(
        self,
        held: HeldRobot,
        jog: Jogging,
        verb: str,
        params: Mapping[str, Any],
        begun: list[asyncio.Task[Envelope]] | None = None,
    ) -> Envelope | None:
        """Call a verb; None where the release comes before its answer.

        Args:
            begun: takes the call of a motion; None for a read.
        """
        given = {name: value for name, value in params.items() if value != ""}
        call = asyncio.ensure_future(held.robot.call(verb, given, ANSWER_S, moves=begun is not None))
        if begun is not None:
            begun.append(call)
        release = asyncio.ensure_future(jog.released.wait())
        await asyncio.wait([call, release], return_when=asyncio.FIRST_COMPLETED)
        release.cancel()
        if jog.released.is_set():
            return None
        return call.result()

    @staticmethod
    def _lease_of(held: HeldRobot) -> dict[str, str]:
        return {LEASE_ID: held.lease_id, **({"robot_name": held.part} if held.part else {})}


class LeadTold:
    """Listener to the lead of a held robot.

    Args:
        control: of the page.
        key: of the robot.
        held: the robot.
    """

    def __init__(self, control: HandControl, key: str, held: HeldRobot) -> None:
        self._control, self._key, self._held = control, key, held

    def turned(self, state: str, why: str) -> None:
        self._control.tell_turn(self._key, state, why)

    def let_go(self, why: str) -> None:
        self._control.tell_let_go(self._key, why)

    def over(self, why: str, *, halted: bool) -> None:
        self._held.lead = None
        self._control.tell_turn(self._key, "over", why, halted=halted)

    def lost(self, why: str) -> None:
        self._control.end_soon(self._key, self._held, why)


def stated_positions(state: Mapping[str, Any], units: Mapping[str, str]) -> dict[str, float]:
    """Return the joints of known unit in degrees, of a slide in metres."""
    joints = state.get("joints")
    known = plain_numbers(joints)
    return {key: at * DEGREES_OF[units[key]] for key, at in known.items() if units.get(key) in DEGREES_OF}


def _taken(answer: Envelope) -> str:
    by = "signed with the operator's key" if answer["signed"] else "without a signature"
    return f"Taken from {answer['taken_from']}, {by}."


async def _watch(jog: Jogging) -> None:
    """Release a jog whose beats stay away."""
    while (left := jog.heartbeat + BEAT_S - time.monotonic()) > 0:  # noqa: ASYNC110 - each beat moves the end
        await asyncio.sleep(left)
    jog.release("no beat of the page for 200 ms")


async def _stopped(held: HeldRobot, begun: list[asyncio.Task[Envelope]]) -> Envelope:
    """Stop the robot, again while a command that the stop may have overtaken is open."""
    answer: Envelope = error("nothing was asked", stopped=None)
    for _attempt in range(STOPS_MAX):
        open_before = [each for each in begun if not each.done()]
        answer = await held.robot.stop()
        if not open_before and grade(answer).stopped is True:
            break
        if open_before:
            await asyncio.wait(open_before, timeout=SETTLE_S)
    return answer
