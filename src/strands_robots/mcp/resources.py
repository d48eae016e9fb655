"""Robots as resources of the MCP server: ``robot://ID``, with updates."""

# mypy: disable-error-code="misc, untyped-decorator"
from __future__ import annotations

import asyncio
import contextlib
from collections import Counter
from collections.abc import AsyncIterator, Callable, Mapping
from typing import Any

from mcp.server.mcpserver import Context, MCPServer
from mcp.server.subscriptions import InMemorySubscriptionBus, ResourcesListChanged, ResourceUpdated
from mcp.types import (
    EmptyResult,
    ListResourcesResult,
    PaginatedRequestParams,
    Resource,
    SubscribeRequestParams,
    UnsubscribeRequestParams,
)

from strands_robots.fleet.networks import Networks
from strands_robots.mcp._compat import lowlevel
from strands_robots.mcp.access import AccessOf
from strands_robots.mcp.results import facts, quoted
from strands_robots.utils import ValidationError, device_id

SCHEME = "robot://"
PAGE = 30
"""Robots of one page of resources."""

EVERY_S = 0.5
"""Seconds between two updates of one robot, however many events it has."""

ROBOTS_S = 3.0
"""Seconds between two looks for robots that came or went."""

WATCHED_MAX = 64
"""Robots whose events are followed at once."""


class RobotResources:
    """The robots of all networks as resources, and who is told of their updates.

    Args:
        networks: follow the events of the robots.
    """

    def __init__(self, networks: Networks) -> None:
        self.bus = InMemorySubscriptionBus()
        self._networks = networks
        self._changed: set[str] = set()
        self._watched: dict[str, Callable[[], None]] = {}
        self._wanted: Counter[str] = Counter()
        self._sessions: dict[str, set[Any]] = {}
        self._watching = asyncio.Lock()

    def add_to(self, server: MCPServer[Any], access: AccessOf) -> None:
        """Register the resources and their methods."""

        # Where the annotation has parameters, pydantic copies the context without its request.
        @server.resource(SCHEME + "{robot}", mime_type="application/json")
        async def robot(robot: str, context: Context) -> str:
            """State of one robot: task, lockout, who holds it."""
            return quoted({"robot": robot, **facts(await access(context).caller.query(robot, "getStatus"))})

        below = lowlevel(server)
        below.add_request_handler("resources/list", PaginatedRequestParams, self._list)
        below.add_request_handler("resources/subscribe", SubscribeRequestParams, self._subscribe)
        below.add_request_handler("resources/unsubscribe", UnsubscribeRequestParams, self._unsubscribe)
        server.middleware.append(self._listening)

    @contextlib.asynccontextmanager
    async def published(self) -> AsyncIterator[None]:
        """Publish updates for the length of the block."""
        tasks = [asyncio.ensure_future(self._publish()), asyncio.ensure_future(self._look())]
        try:
            yield
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.wait(tasks)
            watched, self._watched = self._watched, {}
            for end in watched.values():
                await asyncio.to_thread(end)

    async def _list(self, context: Any, params: Any) -> ListResourcesResult:
        found = await asyncio.to_thread(self._networks.find)
        ids = sorted(name for name, (each, _) in found.items() if not each.world and _robot_of(SCHEME + name))
        cursor = str(params.cursor or "") if params is not None else ""
        start = int(cursor) if cursor.isdecimal() and len(cursor) < 8 else 0
        page = [
            Resource(uri=SCHEME + each, name=each, description="State of this robot.", mime_type="application/json")
            for each in ids[start : start + PAGE]
        ]
        end = start + len(page)
        return ListResourcesResult(resources=page, next_cursor=str(end) if end < len(ids) else None)

    async def _subscribe(self, context: Any, params: Any) -> EmptyResult:
        uri = str(params.uri)
        self._sessions.setdefault(uri, set()).add(context.session)
        await self._watch([uri])
        return EmptyResult()

    async def _unsubscribe(self, context: Any, params: Any) -> EmptyResult:
        uri = str(params.uri)
        if context.session in self._sessions.get(uri, ()):
            self._sessions[uri].discard(context.session)
            await self._unwatch([uri])
        return EmptyResult()

    async def _listening(self, context: Any, call_next: Callable[[Any], Any]) -> Any:
        """Follow the robots that a stream of events names, as long as it is open."""
        if context.method != "subscriptions/listen":
            return await call_next(context)
        wanted = (context.params or {}).get("notifications")
        uris = wanted.get("resourceSubscriptions") if isinstance(wanted, Mapping) else None
        named = [str(uri) for uri in uris] if isinstance(uris, list) else []
        await self._watch(named)
        try:
            return await call_next(context)
        finally:
            await asyncio.shield(asyncio.ensure_future(self._unwatch(named)))

    async def _watch(self, uris: list[str]) -> None:
        loop = asyncio.get_running_loop()
        async with self._watching:
            for robot in filter(None, map(_robot_of, uris)):
                self._wanted[robot] += 1
                if robot in self._watched or len(self._watched) >= WATCHED_MAX:
                    continue

                def changed(_event: object, robot: str = robot) -> None:
                    loop.call_soon_threadsafe(self._changed.add, robot)

                self._watched[robot] = await asyncio.to_thread(self._networks.subscribe, robot, changed)

    async def _unwatch(self, uris: list[str]) -> None:
        async with self._watching:
            for robot in filter(None, map(_robot_of, uris)):
                self._wanted[robot] -= 1
                if self._wanted[robot] <= 0 and robot in self._watched:
                    await asyncio.to_thread(self._watched.pop(robot))

    async def _publish(self) -> None:
        while True:
            await asyncio.sleep(EVERY_S)
            changed, self._changed = self._changed, set()
            for robot in changed:
                uri = SCHEME + robot
                await self.bus.publish(ResourceUpdated(uri=uri))
                for session in tuple(self._sessions.get(uri, ())):
                    try:
                        await session.send_resource_updated(uri)
                    except Exception:  # noqa: BLE001 - each transport has its own error for a client that is gone
                        self._sessions[uri].discard(session)
                        await self._unwatch([uri])

    async def _look(self) -> None:
        before: list[str] | None = None
        while True:
            now = sorted(self._networks.announced())
            if before is not None and now != before:
                await self.bus.publish(ResourcesListChanged())
            before = now
            await asyncio.sleep(ROBOTS_S)


def _robot_of(uri: str) -> str:
    """Return the robot of a resource; empty where the address has no robot's id."""
    try:
        return device_id("robot", uri.removeprefix(SCHEME)) if uri.startswith(SCHEME) else ""
    except ValidationError:
        return ""
