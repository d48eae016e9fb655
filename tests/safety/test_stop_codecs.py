"""Emergency stops of a network with a wire of its own, taken by the one e-stop listener of a process."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from typing import Any

import pytest
from fixtures.stop_bus import BusLink, BusMachine, StopBus
from fixtures.waiting import eventually

from strands_robots.safety.orders import StopOrder, StopRefused, StopRules, new_epoch
from strands_robots.safety.reporting import StopRun
from strands_robots.safety.stop_link import ESTOP, VERDICT, StopCodec, StopEvent

SESSION = "session-1"


class EnvelopeCodec(StopCodec):
    """Stops in a JSON envelope that names its issuer, over links that name sessions."""

    names_source = False
    answers = False

    def __init__(self) -> None:
        self.taken: list[tuple[str, bool]] = []
        self.left_out: list[str] = []

    def fields(self, payload: bytes | int | None) -> Mapping[str, Any]:
        return json.loads(payload) if isinstance(payload, bytes) else {}

    def order(
        self, rules: StopRules, stop: StopEvent, fields: Mapping[str, Any], path: str, age_s: float = 0.0
    ) -> StopOrder | StopRefused | None:
        if fields["issuer"] == "us":
            return None
        if stop.source != SESSION:
            return StopRefused(fields["issuer"], "it is another session's")
        return StopOrder(fields["id"], fields["issuer"], path=path, remote=True, network=stop.network)

    def refused(self, refused: StopRefused) -> bool:
        self.left_out.append(refused.source)
        return True

    def begun(self, order: StopOrder, fields: Mapping[str, Any], run: StopRun | None) -> None:
        self.taken.append((order.source, run is not None))


def stop(issuer: str) -> tuple[str, bytes]:
    epoch = new_epoch()
    return epoch, json.dumps({"id": epoch, "issuer": issuer}).encode()


class BothNetworks:
    """A machine on Device Connect, whose robot is on a network with envelopes as well."""

    def __init__(self, stack: ExitStack) -> None:
        self.bus, self.envelopes, self.codec = StopBus(), StopBus(), EnvelopeCodec()
        self.machine = BusMachine(self.bus, "arm-1")
        stack.callback(self.machine.close)
        listener = self.machine.listener
        link = BusLink(self.envelopes)
        registration = listener.register("arm-1", "envelopes", lambda: link, codec=self.codec)
        stack.callback(registration.close)


@pytest.fixture
def site() -> Iterator[BothNetworks]:
    with ExitStack() as stack:
        yield BothNetworks(stack)


def test_stop_of_another_wire_locks_and_halts_and_its_codec_is_told(site: BothNetworks) -> None:
    epoch, payload = stop("console")
    site.envelopes.send(SESSION, ESTOP, payload)
    eventually(lambda: site.machine.epochs() == (epoch,))
    eventually(lambda: site.codec.taken == [("console", True)])


def test_stop_that_comes_again_halts_nothing_and_its_codec_is_told(site: BothNetworks) -> None:
    epoch, payload = stop("console")
    site.envelopes.send(SESSION, ESTOP, payload)
    eventually(lambda: site.machine.plane.robots["arm-1"].reports.get(epoch))
    site.envelopes.send(SESSION, ESTOP, payload)
    eventually(lambda: site.codec.taken == [("console", True), ("console", False)])


def test_network_whose_robots_do_not_answer_gets_no_verdict(site: BothNetworks) -> None:
    epoch, payload = stop("console")
    site.envelopes.send(SESSION, ESTOP, payload)
    eventually(lambda: site.machine.plane.robots["arm-1"].reports.get(epoch))
    other = site.bus.stop()
    eventually(lambda: site.bus.of(VERDICT))
    eventually(lambda: other in site.machine.epochs())
    assert site.envelopes.of(VERDICT) == []


def test_refused_stop_is_recorded_by_its_codec(site: BothNetworks) -> None:
    site.envelopes.send("session-2", ESTOP, stop("console")[1])
    eventually(lambda: site.codec.left_out == ["console"])
    assert site.machine.epochs() == ()


def test_stop_that_its_codec_passes_over_locks_nothing(site: BothNetworks) -> None:
    site.envelopes.send(SESSION, ESTOP, stop("us")[1])
    epoch, payload = stop("console")
    site.envelopes.send(SESSION, ESTOP, payload)
    eventually(lambda: site.machine.epochs() == (epoch,))


def test_stop_over_a_further_connection_ends_in_the_same_function(site: BothNetworks) -> None:
    epoch, payload = stop("console")
    site.machine.listener.accept(StopEvent(ESTOP, SESSION, payload, 0.0, codec=site.codec), "mesh")
    assert site.machine.epochs() == (epoch,)
    assert site.codec.taken == [("console", True)]
