"""The e-stop listener on real transports, with no data plane beside it."""

from __future__ import annotations

import json
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from fixtures.nats_server import NatsServer
from fixtures.safety_site import Site
from fixtures.waiting import eventually, free_port
from fixtures.zenoh_router import ZenohRouter

from strands_robots.audit import read_audit_log
from strands_robots.device_connect.backends import LinkConfig, loopback_config
from strands_robots.device_connect.backends import zenoh as zenoh_backend
from strands_robots.device_connect.stop_link import stop_link
from strands_robots.safety import ed25519
from strands_robots.safety.estop_listener import REFUSAL_INTERVAL_S
from strands_robots.safety.orders import StopRules, new_epoch, signed_bytes
from strands_robots.safety.statements import Purpose
from strands_robots.safety.stop_link import CHECK_IN, ESTOP, VERDICT, StopLink, notification

Broker = ZenohRouter | NatsServer


@pytest.fixture(params=["zenoh router", "nats", "zenoh peers"])
def network(request: pytest.FixtureRequest) -> Iterator[tuple[LinkConfig, Broker | None]]:
    if request.param == "nats":
        with NatsServer() as server:
            yield LinkConfig(transport="nats", connect=(server.url,)), server
    elif request.param == "zenoh router":
        with ZenohRouter() as router:
            yield LinkConfig(connect=(router.endpoint,), mode="client"), router
    else:
        link = loopback_config(free_port())
        data_plane = zenoh_backend.acquire(link)
        yield link, None
        zenoh_backend.release(data_plane)


class Listener:
    """Somebody else on the network, with a link of the same kind, who may send anything."""

    def __init__(self, link: LinkConfig) -> None:
        self.got: list[tuple[str, dict[str, Any], float]] = []
        self.link: StopLink = stop_link(link)
        self.states: list[tuple[bool, float]] = []
        self.link.open((VERDICT,), self._hear, lambda up: self.states.append((up, time.monotonic())))

    def send(self, source: str, event: str = ESTOP, raw: bytes | None = None, **params: Any) -> bool:
        return self.link.publish(source, event, notification(event, params) if raw is None else raw)

    def verdicts(self, epoch: str) -> list[dict[str, Any]]:
        return [params for _, params, _ in self.got if params["estop_id"] == epoch]

    def _hear(self, event: str, source: str, payload: bytes) -> None:
        self.got.append((source, json.loads(payload)["params"], time.monotonic()))


@pytest.fixture
def open_site(network: tuple[LinkConfig, Broker | None]) -> Iterator[Callable[..., tuple[Site, Listener]]]:
    made: list[tuple[Site, Listener]] = []

    def one(*names: str, **options: Any) -> tuple[Site, Listener]:
        site, listener = Site(network[0], *names, **options), Listener(network[0])
        made.append((site, listener))
        eventually(lambda: site.ready() and listener.link.up)
        if not options.get("rules", StopRules)().signed:
            probe(site, listener)
        return site, listener

    yield one
    for site, listener in made:
        site.close()
        listener.link.close()


def probe(site: Site, listener: Listener) -> None:
    """Wait until a stop of the listener reaches the site and the verdict of each robot comes back, then clear it."""
    epoch = new_epoch()

    def answered() -> bool:
        listener.send("probe-1", estop_id=epoch)
        return {each["device_id"] for each in listener.verdicts(epoch)} == set(site.robots)

    eventually(answered)
    site.plane.clear_local("test")


def test_a_stop_is_heard_halts_every_robot_and_each_answers(open_site: Callable[..., tuple[Site, Listener]]) -> None:
    site, listener = open_site("arm-1", "arm-2", "arm-3")
    for robot in site.robots.values():
        robot.start()
    eventually(lambda: all(robot.device.times for robot in site.robots.values()))
    epoch = new_epoch()

    def answers() -> dict[str, dict[str, Any]]:
        return {each["device_id"]: each for each in listener.verdicts(epoch)}

    def answered() -> bool:
        # As a controller does: a link that cannot keep up drops, and what was dropped is sent and answered again.
        listener.send("safety-1", estop_id=epoch, reason="smoke", t=time.time())
        return set(answers()) >= set(site.robots)

    eventually(answered)
    assert set(answers()) == set(site.robots)
    assert all(each["stopped"] is True and each["halted"] == ["policy"] for each in answers().values())
    assert all(each["epochs"] == [epoch] for each in answers().values())
    # The first answer of each is the last one here.
    told = {source: at for source, params, at in reversed(listener.got) if params["estop_id"] == epoch}
    for name, robot in site.robots.items():
        assert robot.device.times[-1] <= told[name]
        assert robot.refuses()


def test_a_retransmitted_stop_halts_once_and_is_answered_again(
    open_site: Callable[..., tuple[Site, Listener]],
) -> None:
    site, listener = open_site("arm-1")
    halts, epoch = len(site.robots["arm-1"].halts), new_epoch()

    def repeated() -> bool:
        listener.send("safety-1", estop_id=epoch)
        return any(each["repeated"] for each in listener.verdicts(epoch))

    eventually(repeated)
    assert len(site.robots["arm-1"].halts) == halts + 1


def test_malformed_oversized_late_and_early_stops_stop_and_the_audit_says_so(
    open_site: Callable[..., tuple[Site, Listener]],
) -> None:
    site, listener = open_site("arm-1")
    robot = site.robots["arm-1"]
    before = len(robot.halts)
    late, early = new_epoch(), new_epoch()

    def four() -> bool:
        listener.send("safety-1", raw=b"\xff not json")
        listener.send("safety-1", raw=b"x" * 200_000)
        listener.send("safety-1", estop_id=late, t=time.time() - 3600)
        listener.send("safety-1", estop_id=early, t=time.time() + 3600)
        return len(site.entries[0].epochs) == 4 and len(robot.halts) > before

    eventually(four, what="four lockouts, and a halt; stops that wait share one")
    eventually(
        lambda: (
            {"late", "ahead", "untimed"}
            <= {each["payload"].get("timing") for each in read_audit_log() if each["event"] == "remote_estop_engaged"}
        )
    )


def test_a_robots_own_event_stops_it_like_its_neighbour(open_site: Callable[..., tuple[Site, Listener]]) -> None:
    site, listener = open_site("arm-1", "arm-2")
    epoch = new_epoch()

    def stopped() -> bool:
        listener.send("arm-1", estop_id=epoch)
        return all(robot.refuses() for robot in site.robots.values())

    eventually(stopped)


def test_a_flood_of_forged_stops_delays_no_true_one_and_stops_nothing(
    open_site: Callable[..., tuple[Site, Listener]],
) -> None:
    key = Ed25519PrivateKey.generate()
    site, listener = open_site("arm-1", rules=lambda: StopRules(allow=("safety-*",), keys=(ed25519.public_half(key),)))
    robot, done = site.robots["arm-1"], threading.Event()

    def refused() -> list[str]:
        """The sources of what the audit holds as refused."""
        return [each["payload"]["source"] for each in read_audit_log() if each["event"] == "estop_refused"]

    def forge() -> None:
        sig = ed25519.encode(bytes(64))
        while not done.is_set():
            for source in forgers:
                sent[source] += listener.send(source, estop_id=new_epoch(), t=1.0, nonce=new_epoch(), sig=sig)
            time.sleep(0.001)

    forgers = ("forger", "safety-9", "safety-1")
    sent = dict.fromkeys(forgers, 0)
    thread, began = threading.Thread(target=forge), time.monotonic()
    thread.start()
    try:
        eventually(lambda: set(forgers) <= set(refused()))
        assert robot.halts == []
        fields = {"estop_id": new_epoch(), "t": time.time(), "nonce": new_epoch()}
        message = signed_bytes(Purpose.EMERGENCY_STOP, "safety-1", fields)
        fields["sig"] = ed25519.encode(key.sign(message))

        def stopped() -> bool:
            listener.send("safety-1", **fields)
            return robot.refuses()

        eventually(stopped)
    finally:
        done.set()
        thread.join()
    # It is locked at once and halted on a thread of its own.
    eventually(lambda: robot.halts)
    assert len(robot.halts) == 1
    # However long a busy machine took: one record of each source in ten seconds.
    recorded, lasted = Counter(refused()), time.monotonic() - began
    for source, count in recorded.items():
        assert count <= 1 + lasted // REFUSAL_INTERVAL_S < sent[source]


def test_a_broker_that_was_killed_is_noticed_and_the_next_stop_comes_through(
    network: tuple[LinkConfig, Broker | None], open_site: Callable[..., tuple[Site, Listener]]
) -> None:
    broker = network[1]
    if broker is None:
        pytest.skip("peers have no broker")
    site, listener = open_site("arm-1")
    broker.kill()
    eventually(lambda: not listener.link.up)
    assert listener.send("safety-1") is False
    broker.start()
    eventually(lambda: site.ready() and listener.link.up)

    def stopped() -> bool:
        listener.send("safety-1", estop_id=epoch)
        return site.robots["arm-1"].refuses()

    epoch = new_epoch()
    eventually(stopped)


def test_a_check_in_reaches_the_plane_from_who_may(open_site: Callable[..., tuple[Site, Listener]]) -> None:
    site, listener = open_site("arm-1", rules=lambda: StopRules(allow=("safety-*", "probe-*"), keys=()))

    def known() -> dict[str, float]:
        listener.send("safety-1", CHECK_IN)
        listener.send("stranger", CHECK_IN)
        found: dict[str, float] = site.plane.checkin.fields(time.monotonic())["controllers"]  # type: ignore[assignment]
        return found

    assert set(eventually(known)) == {"safety-1"}


def own_threads() -> set[threading.Thread]:
    """The threads of Python's own making; a foreign one that once logged stays listed as a dummy."""
    return {thread for thread in threading.enumerate() if not thread.name.startswith("Dummy-")}


def test_the_lane_leaves_no_thread_and_no_connection_behind() -> None:
    with NatsServer() as server:
        for link in (LinkConfig(transport="nats", connect=(server.url,)), loopback_config(free_port())):
            before = own_threads()
            site = Site(link, "arm-1", "arm-2")
            assert len({id(each.link) for each in site.registrations}) == 1
            site.close()
            eventually(lambda before=before: own_threads() <= before)  # type: ignore[misc]


def test_a_link_that_never_comes_up_closes_at_once() -> None:
    for link in (
        LinkConfig(transport="nats", connect=(f"nats://127.0.0.1:{free_port()}",)),
        LinkConfig(connect=(f"tcp/127.0.0.1:{free_port()}",), mode="client", connect_timeout_s=0.5),
    ):
        site = Site(link, "arm-1")
        assert not site.ready()
        site.close()
