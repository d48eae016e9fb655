"""The end of a thorough collection on this machine, on a clock of the test's own."""

from __future__ import annotations

import asyncio
import json
import selectors
from collections.abc import Awaitable, Callable
from types import SimpleNamespace
from typing import Any, cast

import pytest

from strands_robots.device_connect.backends.base import Backend, NoResponderError
from strands_robots.device_connect.discovery import LOOK_EVERY_S, Discovery

Take = Callable[[bytes, str, str | None], Awaitable[None]]


class LeapingSelector(selectors.DefaultSelector):
    """Lets its loop's time leap to the next timer instead of waiting for it."""

    def __init__(self) -> None:
        super().__init__()
        self.at = 0.0

    def select(self, timeout: float | None = None) -> list[Any]:
        ready = super().select(0)
        if not ready and timeout:
            self.at += timeout
        return ready


class LeapingLoop(asyncio.SelectorEventLoop):
    """An event loop whose seconds pass at once."""

    def __init__(self) -> None:
        self._leaping = LeapingSelector()
        super().__init__(self._leaping)

    def time(self) -> float:
        return self._leaping.at


class Wire:
    """A network of this machine: a device for each time, which answers the first probe so many seconds later."""

    def __init__(self, answers: tuple[float, ...]) -> None:
        self.link = SimpleNamespace(
            tenant="default",
            connect=(),
            listen=(),
            meeting_point="tcp/127.0.0.1:1",
            is_peer=False,
            identified=False,
            uses_multicast=False,
            transport="zenoh",
        )
        self.links = 0
        self._answers: dict[str, float] = {f"arm-{number}": at for number, at in enumerate(answers)}
        self._takes: dict[str, Take] = {}
        self._sent: list[asyncio.Task[None]] = []

    async def subscribe_with_subject(self, subject: str, take: Take, *, subscribe_only: bool) -> None:
        self._takes[subject.rpartition(".")[2]] = take

    async def publish(self, subject: str, data: bytes) -> None:
        while self._answers:
            self._sent.append(asyncio.create_task(self._answer(*self._answers.popitem())))

    async def request_once(self, subject: str, data: bytes, within: float) -> bytes:
        raise NoResponderError(subject)

    async def _answer(self, name: str, after: float) -> None:
        await asyncio.sleep(after)
        presence = json.dumps({"device_id": name}).encode()
        await self._takes["presence"](presence, f"device-connect.default.{name}.presence", None)

    async def end(self) -> None:
        for each in self._sent:
            each.cancel()
        await asyncio.gather(*self._sent, return_exceptions=True)


@pytest.mark.parametrize(
    ("answers", "found", "ends"),
    [
        pytest.param((0.01, 0.03), 2, 0.23, id="0.2 s after the last answer"),
        pytest.param((0.01, 0.03, 0.5), 2, 0.23, id="without one that is later than that"),
        pytest.param((0.1, 0.5), 2, 2.1, id="four times the longest gap"),
        pytest.param((0.1, 0.5, 2.0), 3, 8.0, id="which a late answer makes longer"),
    ],
)
def test_thorough_collection_waits_in_proportion_to_the_longest_gap(
    answers: tuple[float, ...], found: int, ends: float
) -> None:
    async def collected() -> tuple[int, float]:
        wire = Wire(answers)
        discovery = Discovery(cast(Backend, wire))
        await discovery.start()
        peers = await discovery.collect(60.0, thorough=True)
        now = asyncio.get_running_loop().time()
        await wire.end()
        return len(peers), now

    with asyncio.Runner(loop_factory=LeapingLoop) as runner:
        count, at = runner.run(collected())
    assert count == found
    # It looks at the time again and again, and what goes on meanwhile takes none.
    assert ends - 0.001 <= at <= ends + 3 * LOOK_EVERY_S * 4
