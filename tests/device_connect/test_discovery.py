"""End of a collection, with devices that answer when the test says so."""

import asyncio
import json

from strands_robots.device_connect.backends import loopback_config
from strands_robots.device_connect.backends.base import NoResponderError
from strands_robots.device_connect.discovery import SETTLED_FOR_SURE_HERE_S, Discovery

GAP_S = 0.6 * SETTLED_FOR_SURE_HERE_S
LATE_S = 1.8 * SETTLED_FOR_SURE_HERE_S


class Network:
    """A loopback network without a registry, on which devices answer ``answers[id]`` seconds after the first probe."""

    def __init__(self, **answers):
        self.link, self.links = loopback_config(7447), 1
        self._answers, self._take = answers, {}

    async def subscribe_with_subject(self, subject, take, subscribe_only):
        self._take[subject.rpartition(".")[2]] = take

    async def publish(self, subject, data):
        answers, self._answers = self._answers, {}
        for name, after_s in answers.items():
            asyncio.get_running_loop().call_later(after_s, self._announce, name)

    async def request_once(self, subject, data, within):
        raise NoResponderError(subject)

    def _announce(self, name):
        presence = json.dumps({"device_id": name}).encode()
        self._task = asyncio.ensure_future(
            self._take["presence"](presence, f"device-connect.default.{name}.presence", None)
        )


async def collected(**answers):
    discovery = Discovery(Network(**answers))
    await discovery.start()
    return [peer.id for peer in await discovery.collect(20.0, thorough=True)]


async def test_thorough_collection_waits_longer_where_devices_answer_late():
    assert await collected(quick=0.0, late=GAP_S, later=GAP_S + LATE_S) == ["late", "later", "quick"]


async def test_thorough_collection_ends_early_where_devices_answer_at_once():
    assert await collected(quick=0.0, never=30.0) == ["quick"]
