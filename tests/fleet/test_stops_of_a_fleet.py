"""Stop, emergency stop and resume of all robots of a fleet: verdicts by name, and networks that fail."""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator
from typing import Any, ClassVar

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from fixtures.waiting import eventually
from tests.fleet.scripted import ScriptedNetwork, key_of

from strands_robots import errors
from strands_robots.envelope import error, success
from strands_robots.fleet import Fleet
from strands_robots.fleet.adapter import DEVICE_CONNECT, MESH, LockoutReport, StopRequest
from strands_robots.fleet.lockouts import Enrolled
from strands_robots.fleet.networks import Networks
from strands_robots.fleet.stops import estop_all
from strands_robots.safety.answers import Answer, Progress
from strands_robots.safety.identity import ROBOTS, EnrolledKeys, KeyFile
from strands_robots.safety.network_key import NetworkKey
from strands_robots.safety.roster import Roster
from strands_robots.safety.scope import EVERY_ROBOT, Scope
from strands_robots.safety.sightings import Known, RosterRow
from strands_robots.utils import ValidationError

NEAR = key_of(DEVICE_CONNECT)
KEY = Ed25519PrivateKey.generate()


@pytest.fixture
def near() -> ScriptedNetwork:
    return ScriptedNetwork(DEVICE_CONNECT, {"arm-1": (), "both": ()})


@pytest.fixture
def far() -> ScriptedNetwork:
    return ScriptedNetwork(MESH, {"arm-2": (), "both": ()})


@pytest.fixture
def fleet(near: ScriptedNetwork, far: ScriptedNetwork) -> Iterator[Fleet]:
    with Fleet([near, far]) as joined:
        yield joined


def test_one_press_is_one_stop_on_every_network(fleet: Fleet, near: ScriptedNetwork, far: ScriptedNetwork) -> None:
    stop = fleet.estop("a hand")
    assert near.estops == far.estops == [("a hand", EVERY_ROBOT, stop.estop_id)]
    assert {name: verdict.stopped for name, verdict in stop.items()} == {"arm-1": True, "arm-2": True, "both": True}
    assert stop.ok
    assert fleet.estop().estop_id != stop.estop_id


def test_robot_of_the_roster_that_gives_no_answer_is_named(fleet: Fleet, far: ScriptedNetwork) -> None:
    far.silent.append("arm-9")
    for stop in (fleet.stop(), fleet.estop()):
        assert stop["arm-9"].stopped is None
        assert stop.missing == ("arm-9",)
        assert not stop.ok
        assert "arm-9" in str(stop)
        assert "arm-9" in repr(stop)


def test_robot_that_was_found_and_is_gone_is_named(fleet: Fleet, near: ScriptedNetwork) -> None:
    fleet.robots()
    del near.robots["arm-1"]
    for stop in (fleet.stop(), fleet.estop()):
        assert stop["arm-1"].stopped is None
        assert stop.missing == ("arm-1",)


def test_robot_that_moves_on_one_of_two_networks_moves(
    fleet: Fleet, far: ScriptedNetwork, monkeypatch: pytest.MonkeyPatch
) -> None:
    far.stops = error("bus", stopped=False)
    stop = fleet.estop()
    assert stop["both"].stopped is False
    assert stop.missing == ("arm-2", "both")
    assert "both did not stop" in str(stop)


@pytest.mark.parametrize("verb", ["stop", "estop"])
def test_network_that_fails_hides_no_verdict_of_another(
    fleet: Fleet, far: ScriptedNetwork, monkeypatch: pytest.MonkeyPatch, verb: str
) -> None:
    def lost(*_: object, **__: object) -> Any:
        raise OSError("cable")

    monkeypatch.setattr(far, "stop_all", lost)
    monkeypatch.setattr(far, "emergency_stop", lost)
    stop = getattr(fleet, verb)()
    assert stop["arm-1"].stopped is True
    assert stop["the robots on mesh"].unknown == {"the robots on mesh": "cable"}
    assert not stop.ok
    assert "It did not leave on mesh: cable." in str(stop)


def test_network_without_robots_is_no_failure(near: ScriptedNetwork) -> None:
    with Fleet([near, ScriptedNetwork(MESH, {})]) as fleet:
        assert fleet.stop().ok
        assert fleet.estop().ok


def test_fleet_without_any_robot_has_stopped_none() -> None:
    with Fleet([ScriptedNetwork(MESH, {})]) as fleet:
        stop = fleet.estop()
        assert (dict(stop), stop.ok) == ({}, False)


def test_stop_of_a_robot_of_one_network_does_not_become_one_of_all_on_another(
    fleet: Fleet, near: ScriptedNetwork, far: ScriptedNetwork
) -> None:
    stop = fleet.estop(only="arm-1")
    assert near.estops[0][1] == far.estops[0][1] == Scope.named(["arm-1"])
    eventually(lambda: near.remembered and far.remembered, what="the robot, which is known on one network")
    assert {name: verdict.stopped for name, verdict in stop.items()} == {"arm-1": True}
    assert stop.ok
    fleet.estop(only=["nowhere"])
    assert (near.remembered, far.remembered) == (False, False)


def test_named_robot_that_a_network_which_is_being_joined_remembers_is_known(
    near: ScriptedNetwork, far: ScriptedNetwork, monkeypatch: pytest.MonkeyPatch
) -> None:
    row, may_open = RosterRow("arm-7", Known.ENROLLED), threading.Event()
    opened = far.open

    def opens_late() -> None:
        assert may_open.wait(30)
        opened()

    monkeypatch.setattr(far, "open", opens_late)
    third = key_of("third")
    monkeypatch.setattr(Roster, "of", lambda network, *_: Roster(network, (row,) if network == third else ()))
    # Also one that is a name alone.
    with Networks([near, far], {"third": "no peer"}, {"third": lambda: third}) as networks:
        stopping = threading.Thread(target=lambda: estop_all(networks, StopRequest(scope=Scope.named(["arm-7"]))))
        stopping.start()
        try:
            eventually(lambda: near.remembered, what="the robot, which is remembered on another network")
        finally:
            may_open.set()
            stopping.join(30)


def test_named_robot_that_answers_on_another_network_is_known(
    near: ScriptedNetwork, far: ScriptedNetwork, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its network neither remembers nor has found it."""

    def answers(request: StopRequest) -> Any:
        said = Answer("arm-7", True, 0.0, "stopped")
        request.on_progress(Progress("0" * 32, {"arm-7": said}, (), True, 1.0))
        eventually(lambda: far.remembered, what="the robot, which has answered")
        raise OSError("no outcome")

    monkeypatch.setattr(near, "emergency_stop", answers)
    with Networks([near, far]) as networks:
        estop_all(networks, StopRequest(scope=Scope.named(["arm-7"])))
        assert far.remembered


def test_named_robot_that_is_nowhere_is_missing(fleet: Fleet) -> None:
    stop = fleet.estop(only=["arm-1", "nowhere"])
    assert stop["arm-1"].stopped is True
    assert stop.missing == ("nowhere",)


@pytest.mark.parametrize("given", [{"only": 7}, {"only": "arm-1", "cell": "cell-1"}, {"cell": "no cell/"}])
def test_argument_that_cannot_be_read_stops_every_robot(
    fleet: Fleet, near: ScriptedNetwork, caplog: pytest.LogCaptureFixture, given: dict[str, Any]
) -> None:
    with caplog.at_level(logging.WARNING):
        assert fleet.estop(**given).ok
    assert near.estops[0][1] == EVERY_ROBOT
    assert "Ignored: " in caplog.text


def test_lockouts_are_read_and_resumed_by_robot(fleet: Fleet, near: ScriptedNetwork) -> None:
    stop = fleet.estop()
    assert {name: [each.epoch for each in report.lockouts] for name, report in fleet.lockouts().items()} == {
        name: [stop.estop_id] for name in ("arm-1", "arm-2", "both")
    }
    assert fleet.resume(KEY, "arm-1") == {"arm-1": (True, "free")}
    assert sorted(near.locked) == ["both"]
    assert {name: free for name, (free, _) in fleet.resume(KEY).items()} == dict.fromkeys(
        ("arm-1", "arm-2", "both"), True
    )


def test_robot_that_is_locked_on_one_of_two_networks_is_locked(fleet: Fleet, far: ScriptedNetwork) -> None:
    far.locked["both"] = "e" * 32
    report = fleet.lockouts()["both"]
    assert ([each.epoch for each in report.lockouts], report.problem) == (["e" * 32], "")


def test_robot_that_reports_on_one_network_alone_has_the_problem_of_the_other(
    fleet: Fleet, near: ScriptedNetwork, far: ScriptedNetwork, monkeypatch: pytest.MonkeyPatch
) -> None:
    near.locked["both"] = "e" * 32
    monkeypatch.setattr(far, "lockouts", lambda names, *_, **__: [LockoutReport(each, problem="cut") for each in names])
    report = fleet.lockouts()["both"]
    assert ([each.epoch for each in report.lockouts], report.problem) == (["e" * 32], "mesh: cut")


def test_robot_that_no_search_finds_is_asked_by_its_id(
    fleet: Fleet, near: ScriptedNetwork, far: ScriptedNetwork, monkeypatch: pytest.MonkeyPatch
) -> None:
    for network in (near, far):
        monkeypatch.setattr(network, "lockable", lambda *_: [])
    far.locked["arm-2"] = "e" * 32
    assert fleet.resume(KEY, "arm-2") == {"arm-2": (True, "free")}
    assert fleet.resume(KEY) == {}


def test_resume_of_one_robot_asks_all_before_it_names_who_is_not_heard(
    fleet: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    from strands_robots.fleet import lockouts as module  # noqa: PLC0415 - this test alone
    from strands_robots.safety.stop_notes import Unheard  # noqa: PLC0415 - as above

    heard: list[set[str]] = []

    def unheard(network: NetworkKey, names: set[str]) -> Unheard:
        heard.append(names)
        return Unheard()

    monkeypatch.setattr(module, "unheard_now", unheard)
    fleet.resume(KEY, "arm-1")
    assert heard == [{"arm-1", "both"}, {"arm-2", "both"}]


def test_robot_that_stays_locked_on_one_network_is_not_free(
    fleet: Fleet, far: ScriptedNetwork, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(far, "resume", lambda reports, *_: {each.name: (False, "no") for each in reports})
    outcome = fleet.resume(KEY)
    assert outcome["arm-1"][0] is True
    assert outcome["both"] == (False, "no")


@pytest.mark.parametrize("failing", ["near", "far"])
def test_network_that_fails_midway_of_a_resume_hides_no_robot_that_was_freed(
    fleet: Fleet, failing: str, near: ScriptedNetwork, far: ScriptedNetwork, monkeypatch: pytest.MonkeyPatch
) -> None:
    fleet.estop()
    broken, sound = (near, far) if failing == "near" else (far, near)

    def lost(*_: Any) -> Any:
        raise errors.UnreachableError("the connection is lost")

    monkeypatch.setattr(broken, "resume", lost)
    outcome = fleet.resume(KEY)
    told = (False, f"{broken.name} failed: the connection is lost")
    alone = {"arm-1", "arm-2"} & sound.robots.keys()
    assert outcome == dict.fromkeys(alone, (True, "free")) | dict.fromkeys(broken.robots, told)


def test_resume_of_an_absent_robot_is_refused_and_frees_none(fleet: Fleet, near: ScriptedNetwork) -> None:
    fleet.estop()
    with pytest.raises(errors.NoSuchRobotError, match="nowhere"):
        fleet.resume(KEY, ["arm-1", "nowhere"])
    assert "arm-1" in near.locked


def test_robots_that_are_not_heard_are_named_before_others_are_freed(
    fleet: Fleet, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    from strands_robots.fleet import lockouts as module  # noqa: PLC0415 - this test alone
    from strands_robots.safety.stop_notes import Unheard  # noqa: PLC0415 - as above

    monkeypatch.setattr(module, "unheard_now", lambda *_: Unheard(("arm-7",)))
    with caplog.at_level(logging.WARNING):
        fleet.resume(KEY)
    assert "NOT HEARD: arm-7" in caplog.text


def test_network_that_cannot_be_asked_is_absent(fleet: Fleet, far: ScriptedNetwork) -> None:
    far.unreachable = "cable"
    assert sorted(fleet.lockouts()) == ["arm-1", "both"]
    assert fleet.absent == {MESH: "cable"}
    far.unreachable = ""
    assert len(fleet.lockouts()) == 3
    assert fleet.absent == {}


def test_verdict_says_what_was_halted(fleet: Fleet, near: ScriptedNetwork) -> None:
    near.stops = success("stopped", stopped=True, halted=["policy", "teleop"])
    assert fleet.stop()["arm-1"].halted == ("policy", "teleop")


@pytest.mark.parametrize("key", ["-----BEGIN PRIVATE KEY-----", b"32 bytes", object()])
def test_key_that_cannot_sign_refuses_no_stop(
    fleet: Fleet, near: ScriptedNetwork, far: ScriptedNetwork, caplog: pytest.LogCaptureFixture, key: Any
) -> None:
    with caplog.at_level(logging.WARNING):
        stop = fleet.estop(signing_key=key)
    assert stop.ok
    assert (near.signers, far.signers) == ([None], [None])
    assert "signing_key cannot sign" in caplog.text
    assert "Ignored: signing_key cannot sign" in str(stop)


def test_key_that_signs_is_used(fleet: Fleet, near: ScriptedNetwork) -> None:
    key = Ed25519PrivateKey.generate()
    fleet.estop(signing_key=key)
    assert near.signers == [key]


def test_named_robot_that_a_network_remembers_must_answer_there(
    fleet: Fleet, near: ScriptedNetwork, monkeypatch: pytest.MonkeyPatch
) -> None:
    del near.robots["both"]
    assert fleet.estop(only="both").ok
    row = RosterRow("both", Known.ENROLLED)
    monkeypatch.setattr(Roster, "of", lambda network, *_: Roster(network, (row,) if network == near.key else ()))
    stop = fleet.estop(only="both")
    assert stop.missing == ("both",)


def test_network_that_is_left_during_a_stop_loses_no_verdict(
    fleet: Fleet, far: ScriptedNetwork, monkeypatch: pytest.MonkeyPatch
) -> None:
    def left(robot: str) -> bool:
        raise errors.UnreachableError("left")

    monkeypatch.setattr(far, "bears", left)
    assert fleet.estop(only="arm-1")["arm-1"].stopped is True


def test_stated_network_that_is_unknown_counts_as_not_stopped(
    near: ScriptedNetwork, far: ScriptedNetwork, monkeypatch: pytest.MonkeyPatch
) -> None:
    def unknown(network: object) -> Any:
        raise errors.UnreachableError("the mesh of another profile is joined")

    far.unreachable = "another mesh is joined"
    monkeypatch.setattr(type(far), "key", property(lambda self: unknown(self) if self is far else NEAR))
    with Fleet([near, far]) as fleet:
        for stop in (fleet.stop(), fleet.estop()):
            assert stop["arm-1"].stopped is True
            assert stop.missing == ("the robots on mesh",)
            assert "another mesh is joined" in str(stop)


def test_robot_that_was_freed_on_one_network_is_asked_anew_on_the_other(
    fleet: Fleet, near: ScriptedNetwork, far: ScriptedNetwork, monkeypatch: pytest.MonkeyPatch
) -> None:
    fleet.estop()
    resume = near.resume

    def freed(reports: Any, signer: Any, timeout: float) -> Any:
        # One robot that is served on both.
        far.locked.pop("both")
        return resume(reports, signer, timeout)

    def strict(reports: Any, *_: Any) -> Any:
        return {each.name: (True, "free") if each.lockouts else (True, "was not locked") for each in reports}

    monkeypatch.setattr(near, "resume", freed)
    monkeypatch.setattr(far, "resume", strict)
    assert fleet.resume(KEY)["both"] == (True, "free")


def test_two_keys_of_one_id_are_both_left_out(fleet: Fleet, near: ScriptedNetwork, far: ScriptedNetwork) -> None:
    for network, key in ((near, "near"), (far, "far")):
        network.keys = {name: KeyFile(ROBOTS, f"{key}-{name}").load_or_make() for name in network.robots}
    outcome = fleet.enroll()
    assert outcome["both"].outcome is Enrolled.TWO_KEYS
    assert "device_connect shows" in outcome["both"].said and "mesh shows" in outcome["both"].said
    assert {name: each.outcome for name, each in outcome.items() if name != "both"} == dict.fromkeys(
        ("arm-1", "arm-2"), Enrolled.NEW
    )
    assert sorted(EnrolledKeys().load()) == ["arm-1", "arm-2"]


def test_log_of_an_argument_is_written_after_the_stop_has_left(fleet: Fleet, near: ScriptedNetwork) -> None:
    class Noting(logging.Handler):
        """A handler that may block: it notes how many stops have left before it is called."""

        left: ClassVar[list[int]] = []

        def emit(self, record: logging.LogRecord) -> None:
            self.left.append(len(near.estops))

    log, handler = logging.getLogger("strands_robots.fleet.fleet"), Noting()
    log.addHandler(handler)
    try:
        fleet.estop(signing_key="no key")
    finally:
        log.removeHandler(handler)
    assert handler.left == [1]


def test_disk_that_hangs_hides_no_verdict_of_another_network(
    near: ScriptedNetwork, far: ScriptedNetwork, monkeypatch: pytest.MonkeyPatch
) -> None:
    far.unreachable, released, waited = "no hub", threading.Event(), list[bool]()
    read = Roster.of

    def hang(network: NetworkKey, *pressed: float) -> Roster:
        if network == far.key:
            waited.append(released.wait(20))
        return read(network, *pressed)

    monkeypatch.setattr(Roster, "of", hang)
    try:
        with Fleet([near, far]) as fleet:
            assert fleet.stop()["arm-1"].stopped is True
        assert waited == []
    finally:
        released.set()


def test_robots_of_another_network_that_is_stopped_too_are_none_of_other_networks(
    near: ScriptedNetwork, far: ScriptedNetwork, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = {near.key: ("arm-1",), far.key: ("arm-2", "arm-3")}

    def of(network: NetworkKey, *_: float) -> Roster:
        # One more is enrolled for a third network.
        elsewhere = 1 + sum(len(names) for key, names in rows.items() if key != network)
        return Roster(network, tuple(RosterRow(name, Known.ENROLLED) for name in rows[network]), elsewhere=elsewhere)

    monkeypatch.setattr(Roster, "of", of)
    with Fleet([near, far]) as fleet:
        for stop in (fleet.stop(), fleet.estop()):
            assert [each.outcome.roster.elsewhere for each in stop.networks if each.outcome is not None] == [1, 1]


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ((None, ["arm-1"]), "signing_key"),
        (("key", "arm-1"), "signing_key"),
        ((KEY, 5), "robots"),
        ((KEY, None), "robots"),
        ((KEY, [None]), "robots"),
    ],
)
def test_resume_names_an_argument_that_is_unfit_and_asks_no_robot(
    fleet: Fleet, near: ScriptedNetwork, monkeypatch: pytest.MonkeyPatch, arguments: Any, named: str
) -> None:
    monkeypatch.setattr(near, "lockable", lambda timeout: pytest.fail("it looks for robots"))
    with pytest.raises(ValidationError, match=f"^{named} must be"):
        fleet.resume(*arguments)
