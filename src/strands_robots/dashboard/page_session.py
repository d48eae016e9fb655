"""One open page: its WebSocket of state, what it asks for, and what it holds."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import secrets
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from starlette.websockets import WebSocket, WebSocketDisconnect

from strands_robots.arm_mixin import WAIT_S
from strands_robots.bounded_json import json_object
from strands_robots.dashboard.access import OPERATOR, KeyRefusedError, OperatorKey
from strands_robots.dashboard.driving import HandControl
from strands_robots.dashboard.feeds import CAMERA_NAME_MAX, LEFT_OUT, FleetFeed
from strands_robots.dashboard.fleet_model import FleetModel
from strands_robots.dashboard.page_lead import ShownPictures
from strands_robots.dashboard.page_robots import PageRobot, PageRobots
from strands_robots.dashboard.pictures import SMALL, SMALL_HZ, Pictures
from strands_robots.envelope import Envelope, error, is_error, jsonable, success, text_of
from strands_robots.recording.cameras import OVERVIEW
from strands_robots.safety.stop_notes import Unheard, unheard_now
from strands_robots.safety.stopping import grade
from strands_robots.serving.advertised import STOPS
from strands_robots.utils import ValidationError, plain_text, shown, text

logger = logging.getLogger(__name__)

HALTED = "halted here"

TICK_S, SLOW_TICKS = 0.05, 10
"""Seconds between two looks for changes, and looks between two updates of ages and steps."""

JOINTS_TICKS = 2
ALIVE_TICKS = 20
CALL_S = 10.0
WAITING_MAX = 500
CALLS_MAX = 16
THUMBNAILS_MAX = 12
ANSWER_MAX = 20_000
RESUME_S = 5.0
FORGET_S = 5.0
POSE_AGAIN_S = 5.0
"""Seconds between two looks whether a robot's pose can be drawn."""

UNKNOWN_AGAIN_S = 1.0
NOT_KNOWN = "the robot is not known yet."
LED = "led:"
"""Head of the pictures by which the page leads; no network has this name."""


Message = Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Shared:
    """Parts that all pages of a server share.

    Attributes:
        source: the caller that robots see.
        signed: emergency stops are signed.
        starting: ids of robots that were started and will come.
    """

    model: FleetModel
    robots: PageRobots
    operator_key: OperatorKey
    source: str
    signed: bool
    starting: tuple[str, ...] = ()
    pictures: Pictures = field(default_factory=Pictures)


class PageSession:
    """Page with a role, from its first message to its end.

    Args:
        server: what all pages share.
        socket: accepted, and its first message admitted.
        role: viewer or operator.
        local: the page is on this machine.
    """

    def __init__(self, server: Shared, socket: WebSocket, role: str, *, local: bool) -> None:
        self.ticket = secrets.token_urlsafe(18)
        self._server, self._socket = server, socket
        self._role, self._local = role, local
        self._control = HandControl(self._tell_of_hand)
        self._waiting: asyncio.Queue[dict[str, Any]] = asyncio.Queue(WAITING_MAX)
        self._watched, self._joints_at = "", 0.0
        self._forms: list[Any] | None = None
        self._looking: asyncio.Task[None] | None = None
        self._calls: set[asyncio.Task[None]] = set()
        self._thumbnails: dict[str, asyncio.Task[None]] = {}
        self._led: dict[str, asyncio.Task[None]] = {}
        self._sending = asyncio.Lock()

    @property
    def in_use(self) -> set[str]:
        """Keys of the robots that the page looks at or holds."""
        return {self._watched, *self._control.held}

    def tell(self, message: dict[str, Any]) -> None:
        """Queue a message for the page; one that reads nothing loses the newest."""
        with contextlib.suppress(asyncio.QueueFull):
            self._waiting.put_nowait(message)

    def _tell_of_hand(self, message: dict[str, Any]) -> None:
        if message["type"] == "turn" and message["state"] == "over" and message["key"] in self._led:
            # A camera that gives nothing would keep its stream.
            self._led.pop(message["key"]).cancel()
        self.tell(message)

    async def run(self) -> None:
        """Serve the page until it goes, then halt and give back what it holds."""
        sending: asyncio.Task[None] | None = None
        try:
            await self._send(self._hello())
            sending = asyncio.create_task(self._send_changes())
            while True:
                self._take(await self._socket.receive_text())
        except (WebSocketDisconnect, KeyError, RuntimeError) as gone:
            logger.debug("A page is gone, or sent bytes: %s", type(gone).__name__)
        finally:
            for task in (sending, self._looking, *self._led.values(), *self._thumbnails.values()):
                if task is not None:
                    task.cancel()
            await asyncio.shield(asyncio.ensure_future(self._control.leave()))

    def _hello(self) -> dict[str, Any]:
        server = self._server
        return {
            "type": "hello",
            "ticket": self.ticket,
            "role": self._role,
            "local": self._local,
            "operator_key": server.operator_key.present,
            "signed": server.signed,
            "source": server.source,
            "starting": server.starting,
        }

    async def _send(self, message: Mapping[str, Any]) -> None:
        await self._send_text(json.dumps(message, allow_nan=False, default=str))

    async def _send_text(self, message: str) -> None:
        async with self._sending:
            await self._socket.send_text(message)

    async def _send_changes(self) -> None:
        """Send what changed, 20 times a second, and to a slow reader the newest."""
        try:
            await self._follow_changes()
        except (WebSocketDisconnect, RuntimeError) as gone:
            logger.debug("A page is gone: %s", type(gone).__name__)
        except Exception:
            # A page that goes on showing its last state would lie; without its connection it says so and comes again.
            logger.exception("What changed could not be sent to a page; its connection is closed.")
            with contextlib.suppress(WebSocketDisconnect, RuntimeError):
                await self._socket.close(code=1011)

    async def _follow_changes(self) -> None:
        model, since, ticks_since, tick = self._server.model, 0, 0, 0
        while True:
            tick += 1
            slow = tick % SLOW_TICKS == 0
            since, message = model.changes(since, ticks_since if slow else None)
            ticks_since = since if slow else ticks_since
            if message:
                await self._send_text(message)
            elif tick % ALIVE_TICKS == 0:
                # A page makes its connection anew when it hears nothing, and would lose what it holds.
                await self._send_text('{"type": "alive"}')
            while not self._waiting.empty():
                await self._send(self._waiting.get_nowait())
            if self._watched and tick % JOINTS_TICKS == 0:
                joints = model.joints(self._watched, self._joints_at)
                if joints is not None:
                    self._joints_at = joints["at"]
                    await self._send(joints)
                self._tell_new_forms()
            await asyncio.sleep(TICK_S)

    def _take(self, payload: str) -> None:
        """Act on one message of the page; none of them makes the next one wait."""
        message = json_object(payload)
        kind, key = message.get("type"), message.get("key", "")
        if not isinstance(kind, str) or not isinstance(key, str):
            return
        if kind == "beat":
            self._control.beat(key)
        elif kind == "alive":
            self._control.alive(key)
        elif kind == "unjog":
            self._control.release(key, "the page was hidden" if message.get("why") == "hidden" else "released")
        elif kind == "watch":
            self._watch(key)
        elif kind == "thumbnails":
            self._show_thumbnails(message.get("keys"))
        elif kind == "jog":
            self._jog(key, message)
        elif kind == "seen":
            self._seen(key, message.get("number"))
        elif kind in _ASKED:
            if len(self._calls) >= CALLS_MAX and not (kind == "call" and message.get("verb") in STOPS):
                self._answer(message, error("Too many calls of this page are waiting for an answer."))
                return
            task = asyncio.create_task(self._answered(message, lambda: _ASKED[kind](self, key, message)))
            self._calls.add(task)
            task.add_done_callback(self._calls.discard)

    async def _answered(self, message: Message, work: Callable[[], Awaitable[Envelope]]) -> None:
        try:
            answer = await work()
        except (ValidationError, KeyRefusedError) as refused:
            answer = error(str(refused))
        self._answer(message, answer)

    def _answer(self, message: Message, answer: Envelope) -> None:
        facts = {name: value for name, value in answer.items() if name not in ("status", "content", "reason", "jpeg")}
        facts.pop("lease_id", None)
        facts.pop("statement", None)
        clean: Any = jsonable(facts)
        if len(json.dumps(clean, default=str)) > ANSWER_MAX:
            clean = {"note": f"The answer is longer than {ANSWER_MAX} characters."}
        number = message.get("id")
        self.tell(
            {
                "type": "answer",
                "id": number if isinstance(number, int) else 0,
                "ok": not is_error(answer),
                "text": text_of(answer)[:2000],
                "facts": clean,
            }
        )

    def _may_drive(self) -> None:
        if self._role != OPERATOR:
            raise ValidationError("A viewer may look and stop; moving a robot needs the role operator.")

    # What a page asks for.

    def _watch(self, key: str) -> None:
        self._watched, self._joints_at, self._forms = key, 0.0, None
        if self._looking is not None:
            self._looking.cancel()
        self._looking = asyncio.create_task(self._look(key)) if key else None

    async def _look(self, key: str) -> None:
        """Tell a robot's details, then every change of why its pose is not drawn."""
        looked = False
        sent: str | None = None
        while True:
            why = NOT_KNOWN
            with contextlib.suppress(ValidationError):
                robot = self._server.robots.of(key)
                if not looked:
                    self._tell_details(key)
                    await robot.feed.look_closer(robot.id)
                    self._tell_details(key, looked=True)
                why = await self._no_pose(key, robot)
                looked = why != NOT_KNOWN
            if why != sent:
                self.tell({"type": "pose", "key": key, "why": why})
            sent = why
            await asyncio.sleep(UNKNOWN_AGAIN_S if why == NOT_KNOWN else POSE_AGAIN_S)

    async def _no_pose(self, key: str, robot: PageRobot) -> str:
        """Return why no pose of a robot can be drawn, after drawing one; else empty."""
        row = self._server.model.row(key)
        if row is None or not row.forms:
            return NOT_KNOWN
        if OVERVIEW in row.cameras:
            return ""
        if all(form["name"] != "getPose" for form in row.forms):
            return "it has no arm that reports joint angles in degrees."
        drawn = await self._server.pictures.poses.picture(robot.feed, robot.id)
        return text_of(drawn) if is_error(drawn) else ""

    def _tell_details(self, key: str, *, looked: bool = False) -> None:
        """Tell what is known; ``looked`` once the robot itself was asked."""
        details = self._server.model.details(key)
        if details is not None:
            self._forms = details["forms"]
            self.tell({**details, "looked": looked})

    def _tell_new_forms(self) -> None:
        """Tell the details again of a robot that has described its verbs since."""
        row = self._server.model.row(self._watched)
        if row is not None and self._forms is not None and [*row.forms] != self._forms:
            self._tell_details(self._watched)

    def _jog(self, key: str, message: Message) -> None:
        row = self._server.model.row(key)
        units = row.units if row is not None else {}
        why = "A viewer may not move robots." if self._role != OPERATOR else self._control.begin(key, message, units)
        if why:
            self.tell({"type": "jogged", "key": key, "refused": True, "stopped": None, "began": False, "why": why})

    def _show_thumbnails(self, keys: object) -> None:
        wanted = [key for key in keys if isinstance(key, str)][:THUMBNAILS_MAX] if isinstance(keys, list) else []
        for key in set(self._thumbnails) - set(wanted):
            self._thumbnails.pop(key).cancel()
        for key in wanted:
            # A stream that ended, such as one for which there was no room, is asked for again.
            if key not in self._thumbnails or self._thumbnails[key].done():
                self._thumbnails[key] = asyncio.create_task(self._send_thumbnails(key))

    async def _send_thumbnails(self, key: str) -> None:
        with contextlib.suppress(ValidationError, WebSocketDisconnect, RuntimeError):
            robot = self._server.robots.of(key)
            frames = self._server.pictures.camera(robot.feed, robot.id, "", SMALL, SMALL_HZ)
            async with contextlib.aclosing(frames):
                async for frame, _ in frames:
                    await self._send_picture(key, frame)

    async def _send_picture(self, head: str, jpeg: bytes) -> None:
        encoded = head.encode()
        async with self._sending:
            await self._socket.send_bytes(len(encoded).to_bytes(2, "big") + encoded + jpeg)

    async def _call(self, key: str, message: Message) -> Envelope:
        verb, params = text("verb", message.get("verb"), longest=100), message.get("params")
        if verb in STOPS:
            # Before anything else of the message is looked at.
            stopped = self._server.robots.of(key)
            # Its next stretch may be on the way to a robot that stands between two of them.
            self._control.cease(key, "it was halted")
            answer = await stopped.stop()
            self._note_halt(stopped.feed.network, stopped.id, grade(answer).stopped)
            return answer
        if not isinstance(params, dict):
            raise ValidationError(f"params must be an object, not {shown(params)}.")
        robot, row = self._server.robots.of(key), self._server.model.row(key)
        form = next((each for each in row.forms if each["name"] == verb), None) if row is not None else None
        if form is None or verb in LEFT_OUT:
            raise ValidationError(f"verb must be one of this robot's, not {shown(verb)}.")
        moves = form["kind"] != "read"
        if moves:
            self._may_drive()
            params = {**params, **self._control.lease(key)}
        return await robot.call(verb, params, CALL_S + WAIT_S + form["lasts_s"], moves=moves)

    def _note_halt(self, network: str, robot: str, stopped: bool | None) -> None:
        client = self._socket.client
        by = f"{self._role}, {client.host}" if client is not None else self._role
        self._server.model.note_stop(
            HALTED, {"by": by, "stopped": "unknown" if stopped is None else stopped}, network, robot
        )

    async def _take_control(self, key: str, message: Message) -> Envelope:
        self._may_drive()
        robot, signer = self._server.robots.of(key), None
        if message.get("passphrase"):
            signer = await self._opened_key(message)
        part = message.get("part", "")
        answer = await self._control.take(key, robot, part=part if isinstance(part, str) else "", signer=signer)
        held = self._control.holds(key)
        if held and "taken_from" in answer:
            facts = {"from": answer["taken_from"], "signed": answer["signed"]}
            self._server.model.note(robot.feed.network, robot.id, "control taken here", facts)
        self.tell({"type": "control", "key": key, "held": held, "text": text_of(answer)})
        return answer

    async def _give_control(self, key: str, message: Message) -> Envelope:
        answer = await self._control.give(key)
        self.tell({"type": "control", "key": key, "held": False, "text": text_of(answer)})
        return answer

    async def _lead(self, key: str, message: Message) -> Envelope:
        self._may_drive()
        policy = text("policy", message.get("policy"), longest=128)
        task = text("task", message.get("task"), longest=2000)
        camera = text("camera", message.get("camera", ""), longest=CAMERA_NAME_MAX, empty=True)
        answer = await self._control.lead(key, policy, task, pictures=bool(camera))
        pictures = self._control.pictures(key)
        if pictures is not None and not is_error(answer):
            self._led[key] = asyncio.create_task(self._send_pictures(key, camera, pictures))
        return answer

    async def _send_pictures(self, key: str, camera: str, pictures: ShownPictures) -> None:
        """Send numbered pictures of a camera while the page leads by them."""
        with contextlib.suppress(ValidationError, WebSocketDisconnect, RuntimeError):
            robot = self._server.robots.of(key)
            while self._control.pictures(key) is pictures:
                frames = self._server.pictures.camera(robot.feed, robot.id, camera)
                async with contextlib.aclosing(frames):
                    async for picture in frames:
                        await self._send_picture(f"{LED}{pictures.send(picture)}:{key}", picture.jpeg)
                # A stream for which there was no room is asked for again.
                await asyncio.sleep(UNKNOWN_AGAIN_S)

    def _seen(self, key: str, number: object) -> None:
        pictures = self._control.pictures(key)
        if pictures is not None and isinstance(number, int) and not isinstance(number, bool):
            pictures.shown(number)

    async def _give_back(self, key: str, message: Message) -> Envelope:
        why = self._control.give_back(key)
        return error(why) if why else success("The policy has it back.")

    async def _end_lead(self, key: str, message: Message) -> Envelope:
        return await self._control.end_lead(key)

    async def _resume(self, key: str, message: Message) -> Envelope:
        self._may_drive()
        signer = await self._opened_key(message)
        keys = message.get("keys")
        wanted: dict[str, tuple[FleetFeed, list[str]]] = {}
        for shown_key in keys if isinstance(keys, list) else []:
            for each in self._server.robots.twins(str(shown_key)):
                robot = self._server.robots.of(each)
                wanted.setdefault(robot.feed.network, (robot.feed, []))[1].append(robot.id)
        if not wanted:
            raise ValidationError("keys must name at least one robot.")
        outcomes: dict[str, Any] = {}
        unheard = [await asyncio.to_thread(self._unheard, feed) for feed, _ in wanted.values()]
        for feed, robots in wanted.values():
            found = await asyncio.to_thread(feed.resume, robots, signer, RESUME_S)
            for name, (free, said) in found.items():
                outcomes[f"{feed.network}:{name}"] = {"free": free, "said": said[:300]}
                self._server.model.note(feed.network, name, "resume", {"free": free, "said": said})
        locked = [name for name, each in outcomes.items() if not each["free"]]
        answer: Envelope = {"status": "error" if locked else "success", "robots": outcomes}
        said = f"Not resumed: {', '.join(locked)}." if locked else "Resumed. They move again when they are told to."
        said = " ".join([said, *(plain_text(str(each)) for each in unheard if each)])
        names = [name for each in unheard for name in each.names]
        return {**answer, "unheard": names, "content": [{"text": said}], **({"reason": said} if locked else {})}

    def _unheard(self, feed: FleetFeed) -> Unheard:
        """Return the robots of the roster not heard lately; it reads the disk."""
        model, network = self._server.model, self._server.robots.network_key(feed)
        since = model.clock() - FORGET_S
        heard = {row.id for row in model.rows() if row.network == feed.network and (row.heard or since) > since}
        return Unheard() if network is None else unheard_now(network, heard)

    async def _opened_key(self, message: Message) -> Any:
        if not self._local:
            raise KeyRefusedError("The operator's key is used from this server's own machine only (127.0.0.1).")
        return await asyncio.to_thread(self._server.operator_key.open, message.get("passphrase"))

    async def _look_closer(self, key: str, message: Message) -> Envelope:
        robot = self._server.robots.of(key)
        await robot.feed.look_closer(robot.id)
        return {"status": "success", "content": [{"text": "Its limits, units and cameras were read."}]}

    async def _forget(self, key: str, message: Message) -> Envelope:
        self._may_drive()
        if not self._server.model.forget(key, FORGET_S):
            return error(f"{shown(key)} was heard in the last {FORGET_S:g} s, or is not known.")
        return {"status": "success", "content": [{"text": "Forgotten; a stop expects no answer of it any more."}]}


_ASKED: dict[str, Callable[[PageSession, str, Message], Awaitable[Envelope]]] = {
    "call": PageSession._call,
    "take": PageSession._take_control,
    "give": PageSession._give_control,
    "lead": PageSession._lead,
    "give_back": PageSession._give_back,
    "end_lead": PageSession._end_lead,
    "resume": PageSession._resume,
    "forget": PageSession._forget,
    "look": PageSession._look_closer,
}
