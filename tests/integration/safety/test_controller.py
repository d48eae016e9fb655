"""The safety controller on real transports: who stopped, who did not, who is silent, and what the link did."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from fixtures.nats_server import NatsServer
from fixtures.recording_robot import RecordingRobot
from fixtures.safety_site import Site
from fixtures.waiting import eventually
from fixtures.zenoh_router import ZenohRouter

from strands_robots.audit import read_audit_log
from strands_robots.device_connect.backends import LinkConfig
from strands_robots.device_connect.safety_controller import envelope, safety_controller
from strands_robots.envelope import is_error
from strands_robots.safety import ed25519
from strands_robots.safety.answers import Progress
from strands_robots.safety.controller import SafetyController
from strands_robots.safety.orders import StopRules
from strands_robots.utils import ValidationError

Broker = ZenohRouter | NatsServer
Network = tuple[LinkConfig, Broker]


@pytest.fixture(params=["zenoh", "nats"])
def network(request: pytest.FixtureRequest) -> Iterator[Network]:
    if request.param == "nats":
        with NatsServer() as server:
            yield LinkConfig(transport="nats", connect=(server.url,)), server
    else:
        with ZenohRouter() as router:
            yield LinkConfig(connect=(router.endpoint,), mode="client"), router


@pytest.fixture
def controller(network: Network) -> Iterator[SafetyController]:
    made = safety_controller("safety-1", network[0])
    assert made.wait_link(20)
    yield made
    made.close()


@pytest.fixture
def site_of(network: Network) -> Iterator[Callable[..., Site]]:
    made: list[Site] = []

    def one(*names: str, **options: object) -> Site:
        made.append(Site(network[0], *names, **options))  # type: ignore[arg-type]
        eventually(made[-1].ready)
        return made[-1]

    yield one
    for site in made:
        site.close()


def test_every_robot_that_stopped_is_reported_by_name_and_latency(
    controller: SafetyController, site_of: Callable[..., Site]
) -> None:
    sites = [site_of("arm-1", "arm-2"), site_of("arm-3")]
    for site in sites:
        for robot in site.robots.values():
            robot.start()
    report = controller.stop(["arm-1", "arm-2", "arm-3"], "smoke", deadline_s=20)
    assert report.ok
    assert set(report.stopped) == {"arm-1", "arm-2", "arm-3"}
    assert all(0 < each.latency_ms <= report.elapsed_ms for each in report.stopped.values())
    for site in sites:
        for name, robot in site.robots.items():
            assert robot.refuses()
            assert report.stopped[name].facts["halted"] == ["policy"]
            assert robot.reasons == ["smoke"]
    assert not is_error(envelope(report))


def test_the_wedged_the_silent_and_the_willing_are_told_apart(
    controller: SafetyController, site_of: Callable[..., Site], caplog: pytest.LogCaptureFixture
) -> None:
    release = threading.Event()
    site_of("well", robots={"wedged": RecordingRobot(before_halt=lambda: release.wait(60))}, deadline_s=1.0)
    seen: list[Progress] = []
    report = controller.stop(["well", "wedged", "absent"], deadline_s=4.0, on_progress=seen.append)
    release.set()
    assert set(report.stopped) == {"well"}
    assert set(report.not_stopped) == {"wedged"}
    assert "no answer in 1 s" in report.not_stopped["wedged"].why
    assert report.silent == ("absent",)
    assert not report.ok
    assert {"absent", "wedged"} <= {name for each in seen for name in each.unconfirmed}
    assert "wedged DID NOT STOP" in caplog.text
    assert "absent" in caplog.text
    assert is_error(envelope(report))


def test_nobody_at_all_is_not_a_success(controller: SafetyController) -> None:
    report = controller.stop(deadline_s=0.2)
    assert not report.ok
    assert report.link
    assert is_error(envelope(report))


def test_the_same_stop_again_is_answered_and_halts_nobody_twice(
    controller: SafetyController, site_of: Callable[..., Site]
) -> None:
    site = site_of("arm-1")
    first = controller.stop(["arm-1"], deadline_s=20)

    def repeated() -> bool:
        again = controller.stop(["arm-1"], estop_id=first.estop_id, deadline_s=20)
        assert again.ok
        return again.stopped["arm-1"].facts["repeated"] is True

    eventually(repeated)
    assert len(site.robots["arm-1"].halts) == 1


def test_a_robot_that_resumed_this_very_stop_says_that_it_does_not_act_on_it(
    controller: SafetyController, site_of: Callable[..., Site]
) -> None:
    site = site_of("arm-1")
    first = controller.stop(["arm-1"], deadline_s=20)
    site.plane.clear_local("ann")

    def refused() -> bool:
        # A late answer to a repetition of the first one may end this one.
        return set(controller.stop(["arm-1"], estop_id=first.estop_id, deadline_s=20).refused) == {"arm-1"}

    eventually(refused)


def test_a_lost_link_is_told_and_the_stop_is_delivered_when_it_is_back(
    network: Network, site_of: Callable[..., Site]
) -> None:
    site, states = site_of("arm-1"), []
    controller = safety_controller("safety-1", network[0], on_link=states.append)
    try:
        assert controller.wait_link(20)
        network[1].kill()
        eventually(lambda: states[-1:] == [False])
        reports = []
        thread = threading.Thread(target=lambda: reports.append(controller.stop(["arm-1"], deadline_s=60)))
        thread.start()
        time.sleep(0.3)
        assert not site.robots["arm-1"].refuses()
        network[1].start()
        thread.join()
        assert reports[0].ok
        assert site.robots["arm-1"].refuses()
    finally:
        controller.close()


def test_a_stop_on_a_dead_link_says_that_it_never_left(network: Network, caplog: pytest.LogCaptureFixture) -> None:
    network[1].kill()
    controller = safety_controller("safety-1", network[0])
    report = controller.stop(["arm-1"], deadline_s=0.3)
    controller.close()
    assert not report.link
    assert report.silent == ("arm-1",)
    assert "never left" in caplog.text


def test_two_controllers_at_once_leave_two_epochs(network: Network, site_of: Callable[..., Site]) -> None:
    site = site_of("arm-1")
    both = [safety_controller(f"safety-{n}", network[0]) for n in (1, 2)]
    assert all(each.wait_link(20) for each in both)
    reports = []
    threads = [threading.Thread(target=lambda c=c: reports.append(c.stop(["arm-1"], deadline_s=20))) for c in both]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for each in both:
        each.close()
    assert all(report.ok for report in reports)
    assert len(site.entries[0].epochs) == 2


def test_only_the_signed_stop_of_a_key_holder_counts_where_keys_are_asked_for(
    network: Network, site_of: Callable[..., Site]
) -> None:
    key = Ed25519PrivateKey.generate()
    site = site_of("arm-1", rules=lambda: StopRules(allow=(), keys=(ed25519.public_half(key),)))
    unsigned = safety_controller("safety-1", network[0])
    signed = safety_controller("safety-1", network[0], signing_key=key)
    assert unsigned.wait_link(20)
    assert signed.wait_link(20)
    assert unsigned.stop(["arm-1"], deadline_s=0.4).silent == ("arm-1",)
    assert not site.robots["arm-1"].refuses()
    assert signed.stop(["arm-1"], deadline_s=20).ok
    unsigned.close()
    signed.close()
    eventually(lambda: any(each["event"] == "estop_refused" for each in read_audit_log()))


def test_a_controller_that_falls_silent_stops_the_robot_that_needs_it(
    network: Network, site_of: Callable[..., Site], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STRANDS_CHECKIN_TIMEOUT_S", "2")
    controller = safety_controller("safety-1", network[0])
    assert controller.wait_link(20)
    controller.check_in_every(0.1)
    site = site_of("arm-1")
    robot = site.robots["arm-1"]
    time.sleep(2.5)
    assert not robot.refuses()
    controller.close()
    eventually(robot.refuses)
    assert "safety-1" in eventually(lambda: robot.reasons)[0]


def test_a_text_in_place_of_names_and_a_bad_deadline_are_refused(controller: SafetyController) -> None:
    with pytest.raises(ValidationError, match="expected"):
        controller.stop("arm-1")
    with pytest.raises(ValidationError, match="deadline_s"):
        controller.stop(deadline_s=0)
