"""Tools of the MCP server: a small fixed set over all robots.

Tool names and descriptions are constants. What a robot says, its name included, is only ever data of a result.
"""

# mypy: disable-error-code="misc, untyped-decorator"
from __future__ import annotations

import asyncio
import contextlib
import json
import time
from collections.abc import AsyncIterator, Mapping
from functools import partial
from typing import Annotated, Any, Literal, TypeAlias

from mcp.server.mcpserver import Context, MCPServer
from mcp.types import InputRequiredResult, ToolAnnotations
from pydantic import Field

from strands_robots.envelope import Envelope, error, is_error, success
from strands_robots.fleet.lockouts import ask_lockouts, by_robot
from strands_robots.fleet.safety_console import StandingController
from strands_robots.mcp.approval import Approvals, Wish
from strands_robots.mcp.caller import AccessOf, acquire_arguments
from strands_robots.mcp.results import INSTEAD, Result, described, facts, picture, quoted, result, row, wanted
from strands_robots.serving.advertised import AdvertisedVerb
from strands_robots.serving.stop_arguments import stop_reason, stop_scope
from strands_robots.utils import shown

PAGE_BYTES = 2600
"""Size of a page of robots; it is in an answer twice, as text and as structured content."""

PROGRESS_S = 0.5

READ = ToolAnnotations(read_only_hint=True, destructive_hint=False, open_world_hint=False)
MOTION = ToolAnnotations(read_only_hint=False, destructive_hint=True, idempotent_hint=False, open_world_hint=False)
STOP = ToolAnnotations(read_only_hint=False, destructive_hint=False, idempotent_hint=True, open_world_hint=False)

# Booleans, texts and NaN are not numbers.
Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Count = Annotated[int, Field(strict=True, ge=0, le=100_000)]
Flag = Annotated[bool, Field(strict=True)]
Robot = Annotated[str, Field(description="The robot's id, as list_robots has it", max_length=128)]
InWorld = Annotated[str, Field(description="Which robot of a simulated world; empty for its first", max_length=128)]
StopRobot = Annotated[str, Field(description="The robot's id, as list_robots has it; empty for all robots")]
StopInWorld = Annotated[
    str, Field(description="Which robot of a simulated world; empty for all of them", max_length=128)
]
Wait = Annotated[Flag, Field(description="Answer at the end of the motion; false needs acquire_control")]
Approach = Annotated[Number | None, Field(description="Degrees of the gripper below the horizontal")]
Speed = Annotated[Number, Field(description="Share of full speed, above 0 and at most 1")]
Answer: TypeAlias = Result | InputRequiredResult


def add_reads(server: MCPServer[Any], access: AccessOf, standing: StandingController) -> None:
    """Add the tools that read."""

    @server.tool(annotations=READ)
    async def list_robots(
        context: Context[Any, Any], start: Annotated[Count, Field(description="next_start of a page")] = 0
    ) -> Result:
        """List the robots in pages: id, type, model, availability, locked or not."""
        networks = access(context).caller.networks
        found = await asyncio.to_thread(networks.find)
        # A world stands for its robots.
        rows = [row(each) for _, (each, _) in sorted(found.items()) if not each.world]
        page = list[dict[str, str | bool]]()
        for each in rows[start:]:
            if page and len(json.dumps([*page, each])) > PAGE_BYTES:
                break
            page.append(each)
        end = start + len(page)
        more = {"next_start": end} if end < len(rows) else {}
        absent = {"absent": networks.missing} if networks.missing else {}
        return result(success(f"{len(page)} of {len(rows)} robots.", robots=page, total=len(rows), **more, **absent))

    @server.tool(annotations=READ)
    async def describe_robot(context: Context[Any, Any], robot: Robot) -> Result:
        """Describe one robot: type, model, verbs, and the JSON Schema of each."""
        return result(described(await access(context).caller.describe(robot)))

    @server.tool(annotations=READ)
    async def get_state(context: Context[Any, Any], robot: Robot) -> Result:
        """Read the state of a robot: task, joints, lockout, who holds it."""
        caller = access(context).caller
        status, state = await asyncio.gather(caller.query(robot, "getStatus"), caller.query(robot, "getState"))
        if is_error(status):
            return result(status)
        return result({**status, **({} if is_error(state) else {"state": facts(state)})})

    @server.tool(annotations=READ)
    async def get_pose(context: Context[Any, Any], robot: Robot, robot_name: InWorld = "") -> Result:
        """Read an arm's tip, approach, joints and gripper, in metres and degrees."""
        return result(await access(context).caller.query(robot, "getPose", _given(robot_name=robot_name)))

    @server.tool(annotations=READ)
    async def get_picture(
        context: Context[Any, Any],
        robot: Robot,
        camera: Annotated[str, Field(description="Name of the camera; empty for the first")] = "",
        width: Count = 640,
        height: Count = 480,
    ) -> Result:
        """Take a picture with a camera of the robot."""
        params = {"camera": camera, "width": width, "height": height}
        return picture(await access(context).caller.query(robot, "getPicture", params))

    @server.tool(annotations=READ)
    async def get_objects(context: Context[Any, Any], robot: Robot, robot_name: InWorld = "") -> Result:
        """Read the objects that can be seen: centre, size and yaw of each."""
        return result(await access(context).caller.query(robot, "getObjects", _given(robot_name=robot_name)))

    @server.tool(annotations=READ)
    async def wait_for(
        context: Context[Any, Any],
        robot: Robot,
        task_id: Annotated[str, Field(description="Of the motion's answer; empty for the last")] = "",
        seconds: Number = 5.0,
        robot_name: InWorld = "",
    ) -> Result:
        """Wait at most 9 s for the end of an arm's motion, and read its result."""
        params = {"task_id": task_id, "seconds": min(seconds, 9.0), **_given(robot_name=robot_name)}
        return result(await access(context).caller.call(robot, "wait", params))

    @server.tool(annotations=READ)
    async def lockouts(context: Context[Any, Any]) -> Result:
        """Read which robots are locked by an emergency stop, since when and by whom."""
        reports = by_robot(await asyncio.to_thread(ask_lockouts, access(context).caller.networks, 2.0))
        rows = {
            name: {"problem": each.problem} if each.problem else {"lockouts": [one.fields() for one in each.lockouts]}
            for name, each in reports.items()
        }
        locked = sum(bool(each.lockouts) for each in reports.values())
        problem = standing.problem
        absent = f" This server does not answer the stops of others: {problem}." if problem else ""
        return result(success(f"{locked} of {len(rows)} robots are locked.{absent}", robots=rows, stands=not problem))


def add_stops(server: MCPServer[Any], access: AccessOf) -> None:
    """Add the tools that stop."""

    @server.tool(annotations=STOP)
    async def stop(context: Context[Any, Any], robot: StopRobot = "", robot_name: StopInWorld = "") -> Result:
        """Stop a robot now, or all of them.

        Only a success confirms it: a refused or missing answer means that it may still move.
        """
        return result(await access(context).caller.stop(robot, robot_name))

    @server.tool(annotations=STOP)
    async def emergency_stop(
        context: Context[Any, Any],
        reason: Annotated[str, Field(description="Why, in up to 200 characters")] = "",
        only: Annotated[list[str] | None, Field(description="Ids of the robots to stop; empty for all robots")] = None,
        cell: Annotated[
            str, Field(description="Stop this cell and robots without one; empty for all robots", max_length=128)
        ] = "",
    ) -> Result:
        """Stop and lock every robot; only a human operator can resume them.

        With only or cell, those robots alone; where none of them is there, every robot.
        """
        scope, _ = stop_scope(only, cell)
        return result(await access(context).caller.emergency_stop(stop_reason(reason)[0], scope))


def add_motions(server: MCPServer[Any], access: AccessOf, approvals: Approvals) -> None:
    """Add the tools that move."""

    carried_out = partial(_carried_out, access, approvals)

    @server.tool(annotations=MOTION)
    async def move(  # noqa: PLR0917 - tools are called by names
        context: Context[Any, Any],
        robot: Robot,
        to: Annotated[dict[str, Number] | None, Field(description="Point of the tip: x, y, z in metres")] = None,
        by: Annotated[dict[str, Number] | None, Field(description="Offset of the tip: dx, dy, dz in metres")] = None,
        joints: Annotated[dict[str, Number] | None, Field(description="Degrees by joint name")] = None,
        place: Annotated[str, Field(description="Name of a saved place, such as home")] = "",
        approach: Approach = None,
        speed: Speed = 0.5,
        robot_name: InWorld = "",
        wait: Wait = True,
    ) -> Answer:
        """Move an arm, by exactly one of to, by, joints and place."""
        ways: dict[str, dict[str, Any]] = {
            "moveTo": {**to, **_given(approach=approach)} if to else {},
            "moveBy": dict(by or {}),
            "moveJoints": {"joints": joints} if joints else {},
            "goTo": {"place": place} if place else {},
        }
        named = [verb for verb, params in ways.items() if params]
        if len(named) != 1:
            return result(error("move takes exactly one of to, by, joints and place."))
        if set(to or ()) - set("xyz") or set(by or ()) - {"dx", "dy", "dz"}:
            return result(error("to takes x, y and z, by takes dx, dy and dz; nothing else."))
        params = {**ways[named[0]], "speed": speed, **_given(robot_name=robot_name)}
        return await carried_out(context, robot, named[0], params, wait=wait)

    @server.tool(annotations=MOTION)
    async def grasp(  # noqa: PLR0917 - tools are called by names
        context: Context[Any, Any],
        robot: Robot,
        action: Literal["pick", "place", "set_gripper"],
        object: Annotated[str, Field(description="pick: name in get_objects; empty to give x, y, z")] = "",  # noqa: A002 - the word of the verb
        on: Annotated[str, Field(description="place: name of the object on which to put it")] = "",
        x: Number | None = None,
        y: Number | None = None,
        z: Number | None = None,
        opening: Annotated[Number | None, Field(description="set_gripper: 0 closed to 1 open")] = None,
        approach: Approach = None,
        speed: Speed = 0.5,
        robot_name: InWorld = "",
        wait: Wait = True,
    ) -> Answer:
        """Pick an object up, put the held one down, or move the gripper."""
        point = _given(x=x, y=y, z=z, approach=approach, speed=speed)
        verb, params = {
            "pick": ("pick", {**_given(object=object), **point}),
            "place": ("place", {**_given(on=on), **point}),
            "set_gripper": ("setGripper", _given(opening=opening)),
        }[action]
        return await carried_out(context, robot, verb, {**params, **_given(robot_name=robot_name)}, wait=wait)

    @server.tool(annotations=MOTION)
    async def run_policy(  # noqa: PLR0917 - tools are called by names
        context: Context[Any, Any],
        robot: Robot,
        instruction: Annotated[str, Field(description="What to do, 1 to 2000 characters")],
        policy_provider: Annotated[str, Field(description="Policy that decides; mock follows no instruction")] = "mock",
        duration: Annotated[Number, Field(description="Longest time in seconds")] = 30.0,
        robot_name: InWorld = "",
        wait: Wait = True,
    ) -> Answer:
        """Run a policy on a robot, to its end."""
        params = {"instruction": instruction, "policy_provider": policy_provider, "duration": duration}
        return await carried_out(context, robot, "execute", {**params, **_given(robot_name=robot_name)}, wait=wait)


def add_calls(server: MCPServer[Any], access: AccessOf, approvals: Approvals) -> None:
    """Add the tool that calls any verb."""

    @server.tool(annotations=MOTION)
    async def call_robot(
        context: Context[Any, Any],
        robot: Robot,
        verb: Annotated[str, Field(description="A verb of describe_robot", max_length=100)],
        arguments: Annotated[dict[str, Any] | None, Field(description="By name, as its parameters say")] = None,
    ) -> Answer:
        """Call any verb of a robot; a motion answers at its end."""
        given, caller = dict(arguments or {}), access(context).caller
        if verb in INSTEAD:
            return result(error(f"call_robot does not call {verb}: {INSTEAD[verb]}."))
        found = wanted(await caller.describe(robot), verb, given)
        if not isinstance(found, AdvertisedVerb):
            return result(found)
        if found.reads:
            return picture(await caller.query(robot, verb, given, found.lasts_s))
        # Our verbs keep their meaning: a policy is followed to its end, and an arm's motion by its task.
        if found.own or (verb != "execute" and "wait" not in found.by_name):
            return await _carried_out(access, approvals, context, robot, verb, given, own=found)
        wait = given.pop("wait", True)
        if not isinstance(wait, bool):
            return result(error(f"wait must be true or false, not {shown(wait)}."))
        return await _carried_out(access, approvals, context, robot, verb, given, wait=wait)


def add_control(server: MCPServer[Any], access: AccessOf, approvals: Approvals) -> None:
    """Add the tools of the control lease."""

    @server.tool(annotations=STOP)
    async def acquire_control(
        context: Context[Any, Any],
        robot: Robot,
        ttl_s: Annotated[Number, Field(description="0.5 to 600")] = 60.0,
        robot_name: InWorld = "",
    ) -> Answer:
        """Hold a robot while connected; it halts ttl_s seconds after a lost client."""
        client = access(context)
        params = {"ttl_s": ttl_s, **_given(robot_name=robot_name)}
        sent = acquire_arguments(ttl_s, robot_name)
        run = partial(client.caller.acquire, robot, ttl_s, robot_name)
        return await approvals.carry_out(context, client, Wish(robot, "acquireControl", params, sent, run))

    @server.tool(annotations=STOP)
    async def release_control(context: Context[Any, Any], robot: Robot, robot_name: InWorld = "") -> Result:
        """Free a robot that you hold, for others."""
        return result(await access(context).caller.release(robot, robot_name))


async def _carried_out(  # noqa: PLR0917 - who asks, and what of which robot
    access: AccessOf,
    approvals: Approvals,
    context: Context[Any, Any],
    robot: str,
    verb: str,
    params: Mapping[str, Any],
    *,
    wait: bool = True,
    own: AdvertisedVerb | None = None,
) -> Answer:
    """Carry out a motion, with the approval of the client's user if it needs one.

    ``own`` is the description of a verb whose meaning is not known here.
    """
    client = access(context)

    async def run() -> Envelope:
        async with _progress(context, partial(client.caller.call, robot, "getStatus")):
            if own is not None:
                return await client.caller.act(robot, own, params)
            if verb == "execute":
                return await client.caller.run_policy(robot, params, wait=wait)
            return await client.caller.move(robot, verb, sent)

    sent = params if own is not None or verb == "execute" else {**params, "wait": wait}
    return await approvals.carry_out(context, client, Wish(robot, verb, params, sent, run))


@contextlib.asynccontextmanager
async def _progress(context: Context[Any, Any], status: partial[Any]) -> AsyncIterator[None]:
    """Report what the robot does as progress of the call, to a client that wants it."""
    if not (context.request_context.meta or {}).get("progress_token"):
        yield
        return
    began = time.monotonic()

    async def report() -> None:
        while True:
            await asyncio.sleep(PROGRESS_S)
            said = facts(await status())
            fields = {
                name: said[name]
                for name in ("task_status", "instruction", "step_count", "running_policies")
                if name in said
            }
            await context.report_progress(time.monotonic() - began, message=quoted(fields)[:1000])

    reporting = asyncio.ensure_future(report())
    try:
        yield
    finally:
        reporting.cancel()
        await asyncio.wait([reporting])


def _given(**arguments: Any) -> dict[str, Any]:
    """Return the arguments that were given: an empty text or None was not."""
    return {name: value for name, value in arguments.items() if value not in (None, "")}
