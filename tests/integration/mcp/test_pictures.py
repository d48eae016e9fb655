"""A question about a motion names a picture that the user can open, in both revisions and on both transports."""

from __future__ import annotations

import asyncio
import base64
import io
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlparse

import pytest
from fixtures.mcp_site import McpSite
from fixtures.toy_robots import ToyRobot

pytest.importorskip("mcp.server.mcpserver", reason="needs the extra mcp", exc_type=ImportError)

import httpx2
import numpy as np
from mcp.types import ElicitResult
from PIL import Image

from strands_robots.device_connect import init_device_connect_sync, loopback_config, stop_device_connect

BOTH = pytest.mark.parametrize("mode", ["legacy", "2026-07-28"])
COLOUR = (200, 120, 40)
SHORT = {"robot": "eye-1", "instruction": "wave", "duration": 0.3}


class SeeingRobot(ToyRobot):
    """A toy with a camera that sees one colour."""

    def camera_frames(self) -> dict[str, Any]:
        """Return its picture."""
        return {"front": np.full((48, 64, 3), COLOUR, np.uint8)}


def sees_the_robot(picture: bytes) -> bool:
    """True for the picture of the robot's camera."""
    with Image.open(io.BytesIO(picture)) as opened:
        opened.load()
        pixel = opened.convert("RGB").getpixel((32, 24))
        assert isinstance(pixel, tuple)
        return opened.format == "JPEG" and max(abs(a - b) for a, b in zip(pixel, COLOUR, strict=True)) < 8


@pytest.fixture(scope="module")
def eye(site: McpSite) -> Iterator[SeeingRobot]:
    robot = SeeingRobot("eye")
    runtime = init_device_connect_sync(robot, peer_id="eye-1", link=loopback_config(site.port))
    yield robot
    stop_device_connect(runtime)
    robot.close()


class Looking:
    """A user who opens the picture of the question before the answer."""

    def __init__(self) -> None:
        self.seen: list[bytes] = []

    async def __call__(self, context: object, params: Any) -> ElicitResult:
        (address,) = re.findall(r"^Picture: (\S+)$", params.message, re.MULTILINE)
        if address.startswith("file:"):
            path = Path(unquote(urlparse(address).path))
            self.seen.append(await asyncio.to_thread(path.read_bytes))
        else:
            async with httpx2.AsyncClient() as browser:
                answer = await browser.get(address)
                assert answer.headers["content-type"] == "image/jpeg"
                self.seen.append(answer.content)
        return ElicitResult(action="accept", content={"approve": True})


@BOTH
async def test_the_question_on_stdio_names_a_file_with_the_picture(site: McpSite, eye: SeeingRobot, mode: str) -> None:
    user = Looking()
    async with site.client(mode=mode, elicitation_callback=user) as client:
        assert not (await client.call_tool("run_policy", SHORT)).is_error
    (picture,) = user.seen
    assert sees_the_robot(picture)


@BOTH
async def test_the_question_over_http_names_a_page_with_the_picture(site: McpSite, eye: SeeingRobot, mode: str) -> None:
    user, token = Looking(), site.token("second", "--approves")
    with site.http() as url:
        async with site.http_client(url, token, mode=mode, elicitation_callback=user) as client:
            assert not (await client.call_tool("run_policy", SHORT)).is_error
        async with httpx2.AsyncClient() as stranger:
            guessed = await stranger.get(url.replace("/mcp", "/pictures/guess.jpg"))
            assert guessed.status_code == 404
    (picture,) = user.seen
    assert sees_the_robot(picture)


@BOTH
async def test_a_client_that_cannot_ask_gets_the_picture_with_the_refusal(
    site: McpSite, eye: SeeingRobot, mode: str
) -> None:
    async with site.client(mode=mode) as client:
        refused = await client.call_tool("run_policy", SHORT)
    assert refused.is_error
    (image,) = (block for block in refused.content if block.type == "image")
    assert sees_the_robot(base64.b64decode(image.data))
