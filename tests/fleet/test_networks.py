"""Networks of one caller: joined side by side, each robot called where it is, stops that wait for no other network."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from typing import Any

import pytest
from fixtures.waiting import eventually
from tests.fleet.scripted import OURS, ScriptedNetwork, function

from strands_robots import errors
from strands_robots.envelope import Envelope, error, success
from strands_robots.fleet import joining
from strands_robots.fleet import networks as module
from strands_robots.fleet.adapter import (
    CLOSED,
    DEVICE_CONNECT,
    MESH,
    STOP_S,
    FoundRobot,
    NetworkAdapter,
    NetworkBusyError,
    Place,
    StopRequest,
)
from strands_robots.fleet.fleet import Fleet
from strands_robots.fleet.networks import Networks
from strands_robots.fleet.stops import estop_all, stop_all
from strands_robots.safety.roster import Roster
from strands_robots.safety.sightings import Known, RosterRow


class SlowNetwork(ScriptedNetwork):
    """A network whose joining waits for a test, as for a broker that does not answer."""

    def __init__(self, name: str, robots: dict[str, object]) -> None:
        super().__init__(name, robots)
        self.opening, self.may_open = threading.Event(), threading.Event()

    def open(self) -> None:
        self.opening.set()
        assert self.may_open.wait(30)
        super().open()


@pytest.fixture
def near() -> ScriptedNetwork:
    return ScriptedNetwork(DEVICE_CONNECT, {"arm-1": OURS, "both": OURS})


@pytest.fixture
def far() -> Iterator[SlowNetwork]:
    network = SlowNetwork(MESH, {"arm-2": OURS, "both": OURS})
    yield network
    network.may_open.set()


@pytest.fixture
def networks(near: ScriptedNetwork, far: SlowNetwork) -> Iterator[Networks]:
    with Networks([near, far]) as joined:
        yield joined


def test_networks_are_open_once_one_of_them_is_joined(networks: Networks, far: SlowNetwork) -> None:
    assert [each.name for each in networks.joined] == [DEVICE_CONNECT]
    far.may_open.set()
    assert [each.name for each in networks.settled()] == [DEVICE_CONNECT, MESH]


def test_a_search_waits_for_the_network_that_is_being_joined(networks: Networks, far: SlowNetwork) -> None:
    found: list[str] = []
    looking = threading.Thread(target=lambda: found.extend(networks.find()))
    looking.start()
    assert far.opening.wait(30)
    far.may_open.set()
    looking.join(30)
    assert sorted(found) == ["arm-1", "arm-2", "both"]


@pytest.mark.parametrize("stop", [stop_all, lambda networks: estop_all(networks, StopRequest("test"))])
def test_stop_leaves_on_one_network_while_the_other_is_being_joined(
    stop: Any, networks: Networks, near: ScriptedNetwork, far: SlowNetwork
) -> None:
    verdicts: list[Any] = []
    stopping = threading.Thread(target=lambda: verdicts.append(stop(networks)))
    stopping.start()
    eventually(lambda: sorted(near.stopped) == ["arm-1", "both"], what="the stop on the joined network")
    assert far.stopped == []
    assert stopping.is_alive()
    far.may_open.set()
    stopping.join(30)
    assert sorted(far.stopped) == ["arm-2", "both"]
    assert verdicts[0].ok


def test_stop_of_one_robot_leaves_on_one_network_while_the_other_is_being_joined(
    networks: Networks, near: ScriptedNetwork, far: SlowNetwork
) -> None:
    answers: dict[str, Envelope] = {}
    stopping = threading.Thread(target=lambda: answers.update(networks.stop("both")))
    stopping.start()
    eventually(lambda: near.stopped == ["both"], what="the stop on the joined network")
    far.may_open.set()
    stopping.join(30)
    assert far.stopped == ["both"]
    assert sorted(answers) == [DEVICE_CONNECT, MESH]


def test_stop_from_a_loop_leaves_on_a_network_as_soon_as_that_is_joined(
    networks: Networks, near: ScriptedNetwork, far: SlowNetwork
) -> None:
    near.stops = error("no such robot", stopped=None)

    async def stop() -> object:
        stopping = asyncio.ensure_future(networks.stop_async("arm-2"))
        await asyncio.sleep(0)
        assert far.stopped == []
        far.may_open.set()
        return await asyncio.wait_for(stopping, 30)

    assert asyncio.run(stop()) == {MESH: far.stops}
    assert far.stopped == ["arm-2"]


def test_stop_from_a_loop_waits_for_no_joining_once_the_robot_has_stopped(
    networks: Networks, near: ScriptedNetwork, far: SlowNetwork
) -> None:
    async def stop() -> object:
        answers = await asyncio.wait_for(networks.stop_async("arm-1"), 30)
        far.may_open.set()
        return answers

    assert asyncio.run(stop()) == {DEVICE_CONNECT: near.stops}


def test_stated_network_that_is_gone_fails_a_stop_though_no_robot_of_it_is_remembered(near: ScriptedNetwork) -> None:
    far = ScriptedNetwork(MESH, {})
    far.unreachable = "no route"
    with Networks([near, far]) as networks:
        for verdict in (stop_all(networks), estop_all(networks, StopRequest("test"))):
            assert not verdict.ok
            assert verdict.missing == ("the robots on mesh",)
            assert "It did not leave on mesh: no route." in str(verdict)
            assert verdict["arm-1"].stopped
            assert networks.missing == {MESH: "no route"}


def test_network_of_this_machine_without_robots_need_not_list_them_beside_one_with_robots(
    near: ScriptedNetwork, monkeypatch: pytest.MonkeyPatch
) -> None:
    empty = ScriptedNetwork(MESH, {})
    monkeypatch.setattr(empty, "place", Place("here", local=True))
    sent = empty.emergency_stop

    def unlisted(*given: Any, **options: Any) -> Any:
        return replace(sent(*given, **options), problems=("no list of them in time",))

    monkeypatch.setattr(empty, "emergency_stop", unlisted)
    with Networks([near, empty]) as networks:
        networks.settled()
        verdict = estop_all(networks, StopRequest("test"))
        assert verdict.ok
        assert [each.network for each in verdict.unreached] == [MESH]
    with Networks([empty]) as networks:
        assert not estop_all(networks, StopRequest("test")).ok


def test_mesh_that_no_one_asked_for_fails_no_stop(near: ScriptedNetwork) -> None:
    far = ScriptedNetwork(MESH, {})
    far.unreachable = "no hub"
    with Networks([near, far], unasked={MESH}) as networks:
        assert stop_all(networks).ok
        assert near.stopped == ["arm-1", "both"]
        assert (networks.absent, networks.missing) == ({MESH: "no hub"}, {})


def test_none_in_reach_is_refused_with_each_reason(near: ScriptedNetwork) -> None:
    near.unreachable = "no broker"
    far = ScriptedNetwork(MESH)
    far.unreachable = "no hub"
    networks = Networks([near, far])
    with pytest.raises(errors.UnreachableError, match="device_connect: no broker; mesh: no hub"):
        networks.open()
    with pytest.raises(errors.UnreachableError, match="not joined"):
        networks.settled()


def test_networks_that_are_left_while_one_is_being_joined_leave_it_too(near: ScriptedNetwork, far: SlowNetwork) -> None:
    networks = Networks([near, far])
    networks.open()
    assert far.opening.wait(30)
    networks.close()
    left = threading.Event()
    far.close = left.set  # type: ignore[method-assign]
    far.may_open.set()
    assert left.wait(30)
    assert networks.joined == ()


def test_absent_networks_that_no_one_asked_for_are_not_told(near: ScriptedNetwork) -> None:
    far = ScriptedNetwork(MESH)
    far.unreachable = "no hub"
    with Networks([near, far], {"other": "left out"}, unasked=(MESH, "other")) as networks:
        networks.settled()
        assert networks.absent == {MESH: "no hub", "other": "left out"}
        assert networks.missing == {}
    near.unreachable = "no broker"
    with pytest.raises(errors.UnreachableError) as refused, Networks([near, far], unasked=(MESH,)):
        pytest.fail("joined")
    assert refused.value.why == "no broker"


class TestInTurn:
    """The second network is joined only where the first one does not do."""

    @pytest.fixture
    def far(self) -> ScriptedNetwork:
        return ScriptedNetwork(MESH, {"arm-2": OURS, "both": OURS})

    @pytest.fixture
    def networks(self, near: ScriptedNetwork, far: ScriptedNetwork) -> Iterator[Networks]:
        with closing(Networks([near, far])) as networks:
            networks.open(in_turn=True)
            yield networks

    def test_read_of_a_robot_of_the_first_joins_no_other(self, networks: Networks, far: ScriptedNetwork) -> None:
        assert networks.call("both", "getStatus", {}, 5.0, moves=False)["status"] == "success"
        assert not far.joined

    def test_read_of_a_robot_of_the_second_joins_it(self, networks: Networks, far: ScriptedNetwork) -> None:
        assert networks.call("arm-2", "getStatus", {}, 5.0, moves=False)["status"] == "success"
        assert far.calls

    def test_absent_robot_is_asked_for_once(
        self, networks: Networks, near: ScriptedNetwork, far: ScriptedNetwork
    ) -> None:
        far.unreachable = "no hub"
        with pytest.raises(errors.NoSuchRobotError):
            networks.call("arm-9", "getStatus", {}, 5.0, moves=False)
        assert len(near.calls) == 1

    def test_motion_and_search_join_all(self, networks: Networks, far: ScriptedNetwork) -> None:
        with pytest.raises(errors.AmbiguousRobotError):
            networks.call("both", "moveTo", {"x": 1}, 5.0)
        assert far.joined
        assert sorted(networks.find()) == ["arm-1", "arm-2", "both"]

    def test_second_is_joined_where_the_first_cannot_be(self, near: ScriptedNetwork, far: ScriptedNetwork) -> None:
        near.unreachable = "no broker"
        with closing(Networks([near, far])) as networks:
            networks.open(in_turn=True)
            assert networks.joined == (far,)
            assert networks.missing == {DEVICE_CONNECT: "no broker"}

    def test_stop_leaves_on_both(self, networks: Networks, near: ScriptedNetwork, far: ScriptedNetwork) -> None:
        networks.stop("both")
        assert (near.stopped, far.stopped) == (["both"], ["both"])


def test_networks_are_joined_anew_only_once_the_attempt_before_has_ended(
    near: ScriptedNetwork, far: SlowNetwork
) -> None:
    networks = Networks([near, far])
    networks.open()
    assert far.opening.wait(30)
    networks.close()
    networks.open()
    far.may_open.set()
    assert networks.settled() == (near, far)
    assert far.joined
    networks.close()
    assert not far.joined


class Panic(BaseException):
    """What a binding raises."""


def test_panic_while_joining_hangs_no_stop(near: ScriptedNetwork, monkeypatch: pytest.MonkeyPatch) -> None:
    far = ScriptedNetwork(MESH, {})

    def panics() -> None:
        raise Panic("poisoned")

    monkeypatch.setattr(far, "open", panics)
    with Networks([near, far]) as networks:
        assert stop_all(networks)["arm-1"].stopped
        assert networks.absent == {MESH: "Panic: poisoned"}
    with pytest.raises(Panic), Networks([far]):
        pytest.fail("joined")


def test_refusal_without_a_reason_is_no_joining(near: ScriptedNetwork, monkeypatch: pytest.MonkeyPatch) -> None:
    far = ScriptedNetwork(MESH)

    def refused() -> None:
        raise errors.UnreachableError("")

    monkeypatch.setattr(far, "open", refused)
    with Networks([near, far]) as networks:
        assert networks.settled() == (near,)
        assert networks.absent[MESH]


def test_interrupt_while_joining_leaves_every_network(near: ScriptedNetwork, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted() -> None:
        raise KeyboardInterrupt

    networks = Networks([near])
    monkeypatch.setattr(near, "open", interrupted)
    with pytest.raises(KeyboardInterrupt):
        networks.open()
    with pytest.raises(errors.UnreachableError, match="not joined"):
        networks.settled()


def test_listener_that_fails_keeps_no_other_from_hearing(
    near: ScriptedNetwork, caplog: pytest.LogCaptureFixture
) -> None:
    heard: list[NetworkAdapter] = []
    networks = Networks([near])
    networks.on_joined(lambda _network: heard[5])  # type: ignore[arg-type,return-value]
    networks.on_joined(heard.append)
    with networks:
        assert heard == [near]
    assert "A listener failed for device_connect" in caplog.text


def test_events_can_be_ended_twice(near: ScriptedNetwork) -> None:
    with Networks([near]) as networks:
        end = networks.subscribe("*", lambda event: None)
        end()
        end()
        assert near.subscribers == []


class TestStays:
    """Networks of a face that lasts: what is not there yet is joined when it comes."""

    @pytest.fixture(autouse=True)
    def often(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(joining, "AGAIN_S", 0.01)

    def test_network_that_comes_later_is_joined_and_told_once(self, near: ScriptedNetwork) -> None:
        far = ScriptedNetwork(MESH, {"arm-2": OURS})
        far.unreachable = "no hub"
        told: list[NetworkAdapter] = []
        with Networks([near, far], stays=True) as networks:
            networks.on_joined(told.append)
            assert networks.absent[MESH] == "no hub"
            assert told == [near]
            far.unreachable = ""
            eventually(lambda: len(told) == 2, what="the network that came later")
            assert networks.absent == {}
            assert sorted(networks.find()) == ["arm-1", "arm-2", "both"]
        assert told == [near, far]

    def test_only_networks_that_someone_asked_for_are_missing(self, near: ScriptedNetwork, far: SlowNetwork) -> None:
        near.unreachable = "the broker is down"
        networks = Networks([near, far], stays=True, unasked=[MESH])
        networks.begin()
        try:
            assert networks.joined == (), "nothing is waited for"
            far.unreachable = "no mesh answers"
            far.may_open.set()
            eventually(lambda: len(networks.absent) == 2, what="both reasons")
            assert networks.missing == {DEVICE_CONNECT: "the broker is down"}
        finally:
            networks.close()

    def test_none_in_reach_is_no_error(self, near: ScriptedNetwork) -> None:
        near.unreachable = "no broker"
        with Networks([near], stays=True) as networks:
            assert networks.joined == ()
            near.unreachable = ""
            eventually(lambda: networks.joined == (near,), what="the broker")

    def test_events_of_a_network_that_comes_later_are_received(self, near: ScriptedNetwork) -> None:
        far = ScriptedNetwork(MESH, {"arm-2": OURS})
        far.unreachable = "no hub"
        events: list[str] = []
        with Networks([near, far], stays=True) as networks:
            end = networks.subscribe("*", lambda event: events.append(event.robot))
            near.say("arm-1", "stateUpdate")
            far.unreachable = ""
            eventually(lambda: bool(far.subscribers), what="the subscription on the mesh")
            far.say("arm-2", "stateUpdate")
            assert events == ["arm-1", "arm-2"]
            end()
            assert (near.subscribers, far.subscribers) == ([], [])

    def test_network_is_not_tried_again_once_the_face_has_ended(self, near: ScriptedNetwork) -> None:
        far = ScriptedNetwork(MESH)
        tries: list[int] = []

        def absent() -> None:
            tries.append(1)
            raise errors.UnreachableError("no hub")

        far.open = absent  # type: ignore[method-assign]
        with Networks([near, far], stays=True):
            eventually(lambda: len(tries) > 2, what="further attempts")
        eventually(lambda: not _alive("join mesh"), what="the end of the attempts")


class TestRouting:
    """Where a call goes."""

    @pytest.fixture
    def far(self) -> ScriptedNetwork:
        return ScriptedNetwork(MESH, {"arm-2": OURS, "both": OURS})

    @pytest.fixture
    def networks(self, near: ScriptedNetwork, far: ScriptedNetwork) -> Iterator[Networks]:
        with Networks([near, far]) as joined:
            joined.settled()
            yield joined

    def test_robot_is_called_on_the_network_that_has_it(self, networks: Networks, far: ScriptedNetwork) -> None:
        assert networks.call("arm-2", "moveTo", {"x": 1}, 5.0)["status"] == "success"
        assert [each[:2] for each in far.calls] == [("arm-2", "moveTo")]
        assert asyncio.run(networks.call_async("arm-2", "getStatus", {}, 5.0, moves=False))["status"] == "success"

    def test_read_of_an_id_on_both_goes_to_the_first(
        self, networks: Networks, near: ScriptedNetwork, far: ScriptedNetwork
    ) -> None:
        networks.call("both", "getStatus", {}, 5.0, moves=False)
        assert near.calls
        assert not far.calls

    def test_read_from_a_loop_asks_no_network_for_a_robot_that_is_known(
        self, networks: Networks, near: ScriptedNetwork, far: ScriptedNetwork
    ) -> None:
        for robot, there in {"arm-1": near, "arm-2": far, "both": near}.items():
            assert asyncio.run(networks.of_async(robot)) is there
            assert asyncio.run(there.describe_async(robot, 5.0)).functions == OURS
        assert near.asked == far.asked == []

    def test_own_verb_is_called_where_it_was_described(
        self, networks: Networks, near: ScriptedNetwork, far: ScriptedNetwork
    ) -> None:
        assert networks.described("both", "getStatus")[0] is near
        network, verb = networks.described("arm-2", "moveTo")
        assert network is far
        assert verb is not None
        near.robots["both"] = far.robots["both"] = (function("brewCoffee"), function("beansLeft", "read"))
        assert networks.described("both", "beansLeft")[0] is near
        with pytest.raises(errors.AmbiguousRobotError):
            networks.described("both", "brewCoffee")

    def test_motion_of_an_id_on_both_is_refused_naming_both(self, networks: Networks) -> None:
        with pytest.raises(errors.AmbiguousRobotError, match="device_connect and mesh"):
            networks.call("both", "moveTo", {}, 5.0)
        answer = asyncio.run(networks.call_async("both", "moveTo", {}, 5.0))
        assert "device_connect and mesh" in answer["content"][0]["text"]

    def test_motion_asks_every_network_whether_it_has_the_robot(self, networks: Networks, far: ScriptedNetwork) -> None:
        networks.call("arm-1", "getStatus", {}, 5.0, moves=False)
        assert far.asked == []
        networks.call("arm-1", "moveTo", {}, 5.0)
        assert far.asked == ["arm-1"]

    def test_read_waits_for_no_network_that_does_not_answer(
        self, networks: Networks, near: ScriptedNetwork, far: ScriptedNetwork, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        hangs = threading.Event()
        monkeypatch.setattr(near, "bears", lambda robot: False)
        monkeypatch.setattr(near, "reaches", lambda robot: hangs.wait(30))
        monkeypatch.setattr(far, "bears", lambda robot: False)
        try:
            assert networks.of("arm-2") is far
        finally:
            hangs.set()

    def test_robot_that_no_network_has_is_refused_with_similar_names(self, networks: Networks) -> None:
        with pytest.raises(errors.NoSuchRobotError, match="Near it: arm-"):
            networks.call("arm-9", "getStatus", {}, 5.0, moves=False)
        assert "arm-9" in asyncio.run(networks.call_async("arm-9", "getStatus", {}, 5.0))["content"][0]["text"]

    def test_stop_goes_to_every_bearer(self, networks: Networks, near: ScriptedNetwork, far: ScriptedNetwork) -> None:
        assert networks.halt("both").stopped is True
        assert (near.stopped, far.stopped) == (["both"], ["both"])
        far.stops = error("no brakes", stopped=False)
        verdict = networks.halt("both")
        assert verdict.stopped is False
        assert list(verdict.not_stopped) == ["both on mesh"]

    def test_stop_of_a_robot_that_is_slow_to_be_known_is_sent_again_and_waited_for(
        self, networks: Networks, near: ScriptedNetwork, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        sent: list[bool] = []

        def slow(robot: str, timeout: float = STOP_S, robot_name: str = "", *, insist: bool = False) -> Envelope | None:
            sent.append(insist)
            return success("stopped", stopped=True) if insist else None

        monkeypatch.setattr(near, "stop", slow)
        assert networks.stop("arm-7")[DEVICE_CONNECT]["stopped"] is True
        assert sent == [False, True]

    def test_stop_of_a_known_robot_does_not_wait_for_a_network_without_it(
        self, networks: Networks, near: ScriptedNetwork, far: ScriptedNetwork, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        sent = threading.Event()

        async def hangs(robot: str, within: float = STOP_S, robot_name: str = "") -> Envelope:
            sent.set()
            await asyncio.Event().wait()
            raise AssertionError

        monkeypatch.setattr(far, "stop_async", hangs)

        async def stop() -> dict[str, Envelope]:
            return await asyncio.wait_for(networks.stop_async("arm-1"), 30)

        assert asyncio.run(stop())[DEVICE_CONNECT]["stopped"] is True
        assert sent.is_set()

    def test_stop_from_a_loop_names_a_bearer_that_does_not_answer(
        self, networks: Networks, far: ScriptedNetwork, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        async def silent(robot: str, within: float = STOP_S, robot_name: str = "") -> Envelope:
            return error("no answer", stopped=None)

        monkeypatch.setattr(far, "stop_async", silent)
        answers = asyncio.run(networks.stop_async("both"))
        assert {name: said["stopped"] for name, said in answers.items()} == {DEVICE_CONNECT: True, MESH: None}

    def test_remembered_decisions_are_bounded(
        self, networks: Networks, near: ScriptedNetwork, far: ScriptedNetwork, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(module, "SHARED_IDS_MAX", 3)
        for number in range(10):
            near.robots[f"twin-{number}"] = far.robots[f"twin-{number}"] = OURS
            with pytest.raises(errors.AmbiguousRobotError):
                networks.call(f"twin-{number}", "moveTo", {}, 5.0)
        assert len(networks._shared_ids) == 3


def test_fleet_stops_on_a_network_while_the_other_is_being_joined(near: ScriptedNetwork, far: SlowNetwork) -> None:
    with Fleet([near, far]) as fleet:
        verdicts: list[Any] = []
        stopping = threading.Thread(target=lambda: verdicts.append(fleet.estop("test")))
        stopping.start()
        eventually(lambda: "arm-1" in near.locked, what="the lockout on the joined network")
        far.may_open.set()
        stopping.join(30)
        assert verdicts[0].ok
        assert near.locked["both"] == far.locked["both"] == verdicts[0].estop_id


def test_search_that_fails_on_one_network_gives_the_robots_of_the_other(
    near: ScriptedNetwork, monkeypatch: pytest.MonkeyPatch
) -> None:
    far = ScriptedNetwork(MESH, {"arm-2": OURS})

    def broken(timeout: float, *, peers: bool) -> list[FoundRobot]:
        raise KeyError("bug")

    with Networks([near, far]) as networks:
        networks.settled()
        monkeypatch.setattr(far, "find", broken)
        assert sorted(networks.find()) == ["arm-1", "both"]
        assert "KeyError" in networks.absent[MESH]
        monkeypatch.undo()
        assert "arm-2" in networks.find()
        assert networks.absent == {}


def _alive(name: str) -> list[threading.Thread]:
    return [each for each in threading.enumerate() if each.name == name]


class TestBusy:
    """A network that takes connections and has not answered in time, as on a loaded machine."""

    @pytest.fixture
    def tries(self, near: ScriptedNetwork, far: SlowNetwork, monkeypatch: pytest.MonkeyPatch) -> list[int]:
        """The attempts to join the mesh, of which the third one succeeds."""
        far.may_open.set()
        tries: list[int] = []
        joined = far.open

        def opened() -> None:
            tries.append(1)
            if len(tries) < 3:
                raise NetworkBusyError("it hangs")
            joined()

        monkeypatch.setattr(far, "open", opened)
        return tries

    @pytest.mark.parametrize("stop", [stop_all, lambda networks: estop_all(networks, StopRequest("test"))])
    def test_stop_is_not_kept_from_it(
        self, stop: Any, tries: list[int], near: ScriptedNetwork, far: SlowNetwork
    ) -> None:
        networks = Networks([near, far])
        assert stop(networks).ok
        assert sorted(far.stopped) == ["arm-2", "both"]
        networks.close()

    def test_stop_of_one_robot_is_not_kept_from_it(
        self, tries: list[int], near: ScriptedNetwork, far: SlowNetwork
    ) -> None:
        networks = Networks([near, far])
        assert sorted(networks.stop("both")) == [DEVICE_CONNECT, MESH]
        networks.close()

    def test_search_does_not_try_it_again(self, tries: list[int], near: ScriptedNetwork, far: SlowNetwork) -> None:
        with Networks([near, far]) as networks:
            networks.find()
            assert (len(tries), networks.absent) == (1, {MESH: "it hangs"})

    def test_it_is_named_once_it_was_tried_long_enough(
        self, tries: list[int], near: ScriptedNetwork, far: SlowNetwork, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(module, "BUSY_S", 0.0)
        with Networks([near, far], unasked={MESH}) as networks:
            assert stop_all(networks).ok
            assert (len(tries), networks.absent) == (2, {MESH: "it hangs"})
            # The next stop tries it once more.
            assert stop_all(networks).ok
            assert networks.absent == {}


def test_robot_that_is_silent_on_a_network_that_remembers_it_is_named_by_a_stop(
    near: ScriptedNetwork, monkeypatch: pytest.MonkeyPatch
) -> None:
    far, rows = ScriptedNetwork(MESH, {}), [RosterRow("arm-1", Known.ENROLLED)]
    monkeypatch.setattr(Roster, "of", lambda network, *_: Roster(network, tuple(rows) if network == far.key else ()))
    networks = Networks([near, far])
    answers = networks.stop("arm-1")
    assert {name: said["stopped"] for name, said in answers.items()} == {DEVICE_CONNECT: True, MESH: None}
    far.unreachable = "cable"
    gone = Networks([near, far])
    assert "cable" in str(gone.stop("arm-1")[MESH]["content"])
    # One that said that it left may be the robot that answered.
    rows[:] = [RosterRow("arm-1", Known.ENROLLED, departed=True)]
    assert list(networks.stop("arm-1")) == [DEVICE_CONNECT]


def test_stop_of_a_name_that_no_network_knows_has_one_answer(near: ScriptedNetwork) -> None:
    networks = Networks([near, ScriptedNetwork(MESH, {})])
    assert list(networks.stop("nobody")) == [DEVICE_CONNECT]
    networks.close()
    assert networks.stop("arm-1") == {DEVICE_CONNECT: error(CLOSED, stopped=None)}


class TestStopLink:
    """Emergency stops that have a connection of their own."""

    @pytest.mark.parametrize("opened", [True, False])
    def test_emergency_stop_waits_for_no_joining(self, near: ScriptedNetwork, far: SlowNetwork, opened: bool) -> None:
        far.has_stop_link = True
        networks = Networks([near, far])
        if opened:
            networks.open()
        verdict = estop_all(networks, StopRequest("test"))
        assert verdict.ok
        assert near.locked["both"] == far.locked["both"] == verdict.estop_id
        assert not far.joined
        far.may_open.set()
        networks.close()

    def test_network_on_which_it_did_not_leave_and_that_has_no_robot_is_named_alone(
        self, near: ScriptedNetwork, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        far = ScriptedNetwork(MESH, {})
        far.has_stop_link = True
        sent = far.emergency_stop

        def unsent(*given: Any, **options: Any) -> Any:
            outcome = sent(*given, **options)
            report = replace(outcome.report, link=False)
            return replace(outcome, report=report, problems=("the broker is gone",))

        monkeypatch.setattr(far, "emergency_stop", unsent)
        networks = Networks([near, far], unasked={MESH})
        verdict = estop_all(networks, StopRequest("test"))
        assert verdict.ok
        assert [each.network for each in verdict.unreached] == [MESH]
        assert networks.absent == {MESH: "the broker is gone"}
        far.silent.append("arm-9")
        assert estop_all(networks, StopRequest("test")).missing == ("arm-9",)

    def test_named_robot_must_answer_where_it_is_and_is_told_once(self, near: ScriptedNetwork) -> None:
        far = ScriptedNetwork(MESH, {"arm-2": OURS})
        verdict = estop_all(Networks([near, far]), StopRequest("test", named=["arm-1", "arm-2", "arm-9"]))
        assert verdict.missing == ("arm-9",)
        assert {each.network: list(each.silent) for each in verdict.networks} == {DEVICE_CONNECT: ["arm-9"], MESH: []}
        assert verdict["arm-1"].stopped and verdict["arm-2"].stopped
