"""Malformed JSON-RPC frames leave the server answering, on both transports, and its memory bounded."""

from __future__ import annotations

import asyncio
import contextlib
import json
import random
from typing import Any

import pytest
from fixtures.mcp_frames import INITIALIZE, RawServer
from fixtures.mcp_site import McpSite
from fixtures.memory import memory_mb

pytest.importorskip("mcp.server.mcpserver", reason="needs the extra mcp", exc_type=ImportError)

import httpx2

FRAMES, HTTP_FRAMES = 5_000, 1_000
"""Frames on stdio, and over HTTP, where each is a request of its own."""

GOOD_EVERY = 500
CONNECTIONS = 4
AT_ONCE = 20
"""Requests of one id."""

GROWTH_MB = 150.0
"""Memory that the server may take besides; frames that were kept would be some gigabytes."""

DEEP = 20_000
ODD: list[Any] = [
    *(None, True, False, 0, -1, 1.5, 10**400, "", "x" * 20_000, "\x00", "\ud83e"),
    *([], [[]], {}, {"a": {}}, "tools/call"),
]
HEADERS = {"Accept": "application/json, text/event-stream", "Content-Type": "application/json"}


def broken(chance: random.Random, good: dict[str, Any]) -> bytes:
    """Return bytes that are no JSON."""
    line = json.dumps(good).encode()
    at = chance.randrange(1, len(line))
    return chance.choice(
        [
            line[:at],
            line[:at] + b"\xff\xfe\x80" + line[at:],
            line[:at] + b"}" + line[at:],
            b"[" * DEEP,
            b'{"a":' * DEEP + b"1" + b"}" * DEEP,
            b"\x00" * 50,
            b"NaN",
            b"",
            chance.randbytes(80).replace(b"\n", b" ").replace(b"\r", b" "),
        ]
    )


def wrong(chance: random.Random, good: dict[str, Any]) -> bytes:
    """Return JSON that is no request, or not one of this protocol."""
    frame: Any = dict(good)
    for part in chance.sample(["jsonrpc", "id", "method", "params"], chance.randint(1, 3)):
        if chance.random() < 0.3:
            del frame[part]
        else:
            frame[part] = chance.choice(ODD)
    frame = chance.choice(
        [
            frame,
            [frame, frame],  # a batch, which the protocol dropped
            [],
            chance.choice(ODD),
            {**good, "params": {"name": chance.choice(ODD), "arguments": chance.choice(ODD)}},
            {**good, "params": {"_meta": chance.choice(ODD)}},
            {"jsonrpc": "2.0", "id": chance.choice(ODD), "result": chance.choice(ODD)},
            {"jsonrpc": "2.0", "method": "notifications/cancelled", "params": {"requestId": chance.choice(ODD)}},
        ]
    )
    return json.dumps(frame).encode()


def malformed(chance: random.Random, number: int) -> bytes:
    good = {"jsonrpc": "2.0", "id": number, "method": "ping", "params": {}}
    return chance.choice([broken, wrong])(chance, good)


def readable(frame: bytes) -> bool:
    """Return whether the bytes are JSON, so that the server may take an id from them."""
    try:
        json.loads(frame)
    except (ValueError, RecursionError):
        return False
    return True


def state(number: object) -> dict[str, Any]:
    params = {"name": "get_state", "arguments": {"robot": "arm-1"}}
    return {"jsonrpc": "2.0", "id": number, "method": "tools/call", "params": params}


def answered(answer: dict[str, Any]) -> None:
    assert answer["result"]["structuredContent"]["status"] == "success", answer


@pytest.mark.timeout(400)
def test_server_on_stdio_answers_after_malformed_frames(site: McpSite) -> None:
    chance = random.Random(11)
    with RawServer(site) as server:
        answered(server.ask(state("before")))
        before = server.memory_mb
        for each in range(FRAMES):
            server.send_raw(malformed(chance, each % 9))
            if each % GOOD_EVERY == 0:
                answered(server.ask(state(f"good {each}")))
        answered(server.ask(state("after")))
        assert server.memory_mb - before < GROWTH_MB
    assert not site.moving


@pytest.mark.timeout(400)
async def test_server_over_http_answers_after_malformed_frames(site: McpSite) -> None:
    chance = random.Random(12)
    frames = iter([(number, malformed(chance, number)) for number in range(HTTP_FRAMES)])
    with site.http() as url:
        async with httpx2.AsyncClient(headers=HEADERS, timeout=60) as http:
            begun = await http.post(url, json=INITIALIZE)
            http.headers["mcp-session-id"] = begun.headers["mcp-session-id"]
            odd = asyncio.Lock()

            async def good(number: object) -> None:
                answer = await http.post(url, json=state(number))
                answered(json.loads(answer.text.partition("data: ")[2].splitlines()[0]))

            async def bad(frame: bytes) -> None:
                answer = await http.post(url, content=frame)
                assert answer.status_code < 500, answer.text

            async def connection() -> None:
                for number, frame in frames:
                    # Of two open requests with one id the first is never answered: only one may have an odd id.
                    async with odd if readable(frame) else contextlib.nullcontext():
                        await bad(frame)
                    if number % GOOD_EVERY == 0:
                        await good(f"good {number}")

            await good("before")
            before = memory_mb(site.server.pid)
            await asyncio.gather(*(connection() for _ in range(CONNECTIONS)))
            same = json.dumps({"jsonrpc": "2.0", "id": 1, "method": "ping"}).encode()
            repeated = [asyncio.ensure_future(bad(same)) for _ in range(AT_ONCE)]
            await asyncio.wait(repeated, return_when=asyncio.FIRST_COMPLETED)
            await good("beside requests of one id")
            for each in repeated:
                each.cancel()  # as a client that gives up
            await asyncio.wait(repeated)
            await good("after")
            assert memory_mb(site.server.pid) - before < GROWTH_MB
    assert not site.moving


def test_a_line_beyond_the_bound_is_read_past_and_the_next_one_is_served(site: McpSite) -> None:
    begun = b'{"jsonrpc":"2.0","id":1,"method":"tools/call","params":{"name":"stop","arguments":{"robot":['
    with RawServer(site) as server:
        server.ask(server.call("first", "get_state", {"robot": "arm-1"}))
        before = server.memory_mb
        for _ in range(2):
            server.send_raw(begun + b"[]," * 8_000_000 + b"[]]}}}")
            stopped = server.ask(server.call("stop", "stop", {"robot": "arm-1"}))
            assert stopped["result"]["structuredContent"]["status"] == "success"
        assert server.memory_mb - before < 20
