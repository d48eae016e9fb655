"""The control lease: who holds a robot, and what it admits."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Any

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from fixtures.toy_robots import ToyRobot, ToyWorld
from fixtures.waiting import eventually

from strands_robots.envelope import RefusalReason
from strands_robots.safety import ed25519
from strands_robots.safety.resume import TAKE_PURPOSE, VERSION, sign_take
from strands_robots.serving.control import ControlChange, ControlLease, LeaseWatch, NotHolderError
from strands_robots.serving.control_leases import CONTROL_VERBS, leases_of
from strands_robots.serving.pipeline import Command, Pipeline, Result
from strands_robots.serving.robot_verbs import TASK_VERBS, WORLD_VERBS
from strands_robots.utils import canonical_json

KEY = Ed25519PrivateKey.generate()
SECRET = "a secret of agent-a"
PUBLIC = ed25519.public_half(KEY)


class Clock:
    """A clock that the test turns."""

    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        return self.now


class Body:
    """A robot that moves or not, and remembers why it was halted."""

    def __init__(self) -> None:
        self.moves = False
        self.halts: list[str] = []

    def halt(self, reason: str) -> None:
        self.moves = False
        self.halts.append(reason)


class Bench:
    """One lease with a body, a clock and the changes that it told."""

    def __init__(self, *, hardware: bool = True, keys: tuple[bytes, ...] = (PUBLIC,)) -> None:
        self.body, self.clock = Body(), Clock()
        self.changes: list[ControlChange] = []
        self.lease = ControlLease(
            "arm-1",
            self.body.halt,
            self.moving,
            hardware=hardware,
            keys=lambda: keys,
            clock=self.clock,
            wall=self.clock,
            watched=lambda lease: None,
        )
        self.lease.observe(self.changes.append)

    def moving(self) -> bool | None:
        return self.body.moves

    def acquire(self, who: str = "agent-a", ttl_s: float = 60.0, kind: str = "agent") -> str:
        return str(self.lease.acquire(who, kind, ttl_s)["lease_id"])

    def take(self, who: str = "ann", **changed: Any) -> dict[str, Any]:
        """Take control with an assertion in which some fields were changed before it was signed."""
        body = {name: v for name, v in self.assertion().items() if name != "sig"} | changed
        signed = {**body, "sig": ed25519.encode(KEY.sign(canonical_json(body)))}
        return self.lease.take(who, "because", "arm-1", signed)

    def assertion(self) -> dict[str, Any]:
        return sign_take(KEY, "arm-1", self.lease.epoch, clock=self.clock)


@pytest.fixture
def bench() -> Bench:
    return Bench()


def refused(bench: Bench, who: str, lease_id: str = "") -> dict[str, Any]:
    with pytest.raises(NotHolderError) as refusal:
        bench.lease.admit("moveTo", who, lease_id)
    return refusal.value.envelope


def test_holder_moves_and_another_is_refused_with_holder_and_seconds(bench: Bench) -> None:
    held = bench.acquire(ttl_s=60.0)
    bench.lease.admit("moveTo", "agent-a", held).settle()
    bench.clock.now += 20.0
    answer = refused(bench, "agent-b")
    assert (answer["code"], answer["holder"], answer["expires_in_s"]) == ("not_holder", "agent-a", 40.0)
    assert "agent-a" in answer["content"][0]["text"]


def test_name_of_the_holder_without_its_lease_id_is_refused(bench: Bench) -> None:
    bench.acquire("agent-a")
    assert refused(bench, "agent-a")["code"] == "not_holder"


def test_each_motion_renews_the_lease(bench: Bench) -> None:
    held = bench.acquire(ttl_s=60.0)
    for _ in range(5):
        bench.clock.now += 50.0
        bench.lease.admit("moveTo", "agent-a", held).settle()
    assert bench.lease.facts()["expires_in_s"] == 60.0


def test_silent_holder_is_halted_and_the_robot_is_free(bench: Bench) -> None:
    bench.acquire(ttl_s=2.0)
    bench.body.moves = True
    bench.clock.now += 2.0
    bench.lease.expire()
    assert bench.body.halts == ["the control lease of agent-a is over"]
    assert bench.lease.facts()["held"] is False
    assert [each.event for each in bench.changes] == ["acquired", "expired"]


def test_lease_that_is_over_admits_nothing(bench: Bench) -> None:
    held = bench.acquire(ttl_s=2.0)
    bench.clock.now += 3.0
    assert refused(bench, "agent-a", held)["code"] == "lease_over"


def test_released_robot_is_free_for_others(bench: Bench) -> None:
    held = bench.acquire()
    bench.lease.release(held)
    assert bench.body.halts == []
    bench.acquire("agent-b")


def test_motion_on_a_free_robot_holds_it_until_it_has_ended(bench: Bench) -> None:
    leave = bench.lease.admit("moveTo", "agent-a", "")
    assert refused(bench, "agent-b")["expires_in_s"] is None
    bench.body.moves = True
    leave.settle()
    assert refused(bench, "agent-b")["holder"] == "agent-a"
    bench.lease.admit("moveTo", "agent-a", "").settle()
    bench.body.moves = False
    bench.lease.admit("moveTo", "agent-b", "").settle()


def test_motion_with_a_time_is_halted_when_it_is_not_renewed(bench: Bench) -> None:
    bench.lease.admit("moveTo", "agent-a", SECRET, 5.0).settle()
    bench.body.moves = True
    for _ in range(3):
        bench.clock.now += 4.0
        bench.lease.renew(SECRET)
    bench.clock.now += 4.9
    bench.lease.expire()
    assert bench.body.halts == []
    bench.clock.now += 0.1
    bench.lease.expire()
    assert bench.body.halts == ["the control lease of agent-a is over"]
    assert bench.lease.facts()["held"] is False


def test_motion_with_a_time_that_has_ended_is_not_halted(bench: Bench) -> None:
    bench.lease.admit("moveTo", "agent-a", SECRET, 5.0).settle()
    bench.clock.now += 5.0
    bench.lease.expire()
    assert bench.body.halts == []
    assert bench.lease.facts()["held"] is False
    bench.lease.admit("moveTo", "agent-b", SECRET + "b", 5.0).settle()


def test_motion_with_a_time_that_is_still_starting_is_halted(bench: Bench) -> None:
    bench.lease.admit("moveTo", "agent-a", SECRET, 5.0)
    bench.clock.now += 5.0
    bench.lease.expire()
    assert bench.body.halts == ["the control lease of agent-a is over"]


def test_motion_with_a_time_keeps_others_out_until_it_has_ended(bench: Bench) -> None:
    bench.lease.admit("moveTo", "agent-a", SECRET, 5.0).settle()
    bench.body.moves = True
    assert refused(bench, "agent-b")["expires_in_s"] is None
    assert refused(bench, "agent-a", "another secret")["code"] == "not_holder"
    bench.lease.admit("setGripper", "agent-a", SECRET, 5.0).settle()
    assert bench.lease.facts()["for_one_motion"] is True
    bench.body.moves = False
    bench.acquire("agent-b")


def test_motion_that_was_refused_leaves_the_robot_free(bench: Bench) -> None:
    bench.lease.admit("moveTo", "agent-a", "").settle()
    bench.acquire("agent-b")


def test_human_takes_control_and_the_motion_is_halted_before_the_answer(bench: Bench) -> None:
    held = bench.acquire()
    bench.body.moves = True
    answer = bench.take()
    assert answer["status"] == "success"
    assert bench.body.halts == ["control taken by ann: because"]
    displaced = refused(bench, "agent-a", held)
    assert (displaced["code"], displaced["holder"]) == ("displaced", "ann")
    bench.lease.admit("moveTo", "ann", answer["lease_id"]).settle()
    assert bench.changes[-1] == ControlChange("taken", "arm-1", "ann", "human", 2, "because")


@pytest.mark.parametrize(
    ("changed", "why"),
    [
        ({"robot": "arm-2"}, "something else than taking control of arm-1"),
        ({"purpose": "resume"}, "something else"),
        ({"v": 2}, "something else"),
        ({"epoch": 7}, "names epoch 7, and the lease has epoch 1"),
        ({"t": 0.0}, "not fresh"),
        ({"t": True}, "not fresh"),
        ({"t": 1e9}, "not fresh"),
        ({"nonce": 3}, "nonce of the assertion"),
    ],
)
def test_assertion_for_something_else_takes_nothing(bench: Bench, changed: dict[str, Any], why: str) -> None:
    held = bench.acquire()
    answer = bench.take(**changed)
    assert answer["status"] == "error"
    assert why in answer["content"][0]["text"]
    bench.lease.admit("moveTo", "agent-a", held).settle()
    assert bench.body.halts == []


@pytest.mark.parametrize("assertion", [None, {}, {"v": VERSION}, "x", {"sig": None, "purpose": TAKE_PURPOSE}])
def test_unsigned_takeover_is_refused(bench: Bench, assertion: object) -> None:
    bench.acquire()
    assert bench.lease.take("mallory", "because", "arm-1", assertion)["code"] == "not_proven"


@pytest.mark.parametrize("assertion", [None, {}])
def test_takeover_without_an_assertion_is_told_the_command_that_signs_one(bench: Bench, assertion: object) -> None:
    answer = bench.lease.take("mallory", "because", "arm-1", assertion)
    assert "strands-robots take --key FILE" in answer["content"][0]["text"]


def test_assertion_of_another_key_is_refused(bench: Bench) -> None:
    forged = sign_take(Ed25519PrivateKey.generate(), "arm-1", 0, clock=bench.clock)
    assert bench.lease.take("mallory", "because", "arm-1", forged)["code"] == "not_proven"


def test_assertion_is_good_once(bench: Bench) -> None:
    bench.acquire()
    signed = bench.assertion()
    assert bench.lease.take("ann", "because", "arm-1", signed)["status"] == "success"
    assert bench.lease.take("mallory", "because", "arm-1", signed)["status"] == "error"


def test_hardware_without_a_key_cannot_be_taken_and_a_simulation_can() -> None:
    real, simulated = Bench(keys=()), Bench(hardware=False, keys=())
    assert real.lease.take("ann", "because", "arm-1", None)["status"] == "error"
    assert simulated.lease.take("ann", "because", "arm-1", None)["status"] == "success"


def test_lease_ends_in_time_without_a_call() -> None:
    halted = threading.Event()
    watch = LeaseWatch()
    lease = ControlLease("arm-1", lambda reason: halted.set(), lambda: False, watched=watch.add)
    lease.acquire("agent-a", "agent", 0.05)
    assert halted.wait(10.0)
    eventually(lambda: not watch.running, what="the end of the watch")


def test_robot_that_fails_to_halt_keeps_no_other_lease_from_its_end(caplog: pytest.LogCaptureFixture) -> None:
    def fail(reason: str) -> None:
        raise RuntimeError("no bus")

    halted = threading.Event()
    watch = LeaseWatch()
    ControlLease("arm-1", fail, lambda: False, watched=watch.add).acquire("agent-a", "agent", 0.5)
    other = ControlLease("arm-2", lambda reason: halted.set(), lambda: False, watched=watch.add)
    other.acquire("agent-b", "agent", 0.7)
    assert halted.wait(10.0)
    assert "was not halted" in caplog.text
    eventually(lambda: not watch.running, what="the end of the watch")


@pytest.fixture
def robot() -> Iterator[ToyRobot]:
    toy = ToyRobot()
    yield toy
    toy.close()


def pipeline(robot: Any, name: str = "arm-1") -> Pipeline:
    return Pipeline.of(robot, lambda: name, hardware=False, authorize=lambda command, arguments: None)


def served(line: Pipeline, caller: str, name: str, **arguments: Any) -> Result:
    results: list[Result] = []
    verbs = {**TASK_VERBS, **WORLD_VERBS} if isinstance(line.robot, ToyWorld) else TASK_VERBS
    line.serve(Command(verbs[name], arguments, caller, line.pending.arrive()), results.append)
    return results[0]


def test_lease_holds_on_every_network_of_the_robot(robot: ToyRobot) -> None:
    device, peer = pipeline(robot), pipeline(robot, "peer-1")
    lease_id = served(device, "agent-a", "acquireControl").result["lease_id"]
    result = served(peer, "agent-b", "execute", instruction="wave")
    assert result.refusal is not None
    assert result.refusal.why is RefusalReason.CONTROL
    assert result.result["holder"] == "agent-a"
    assert served(peer, "agent-a", "execute", instruction="wave", lease_id=lease_id).result["status"] == "success"


def test_stop_and_reads_need_no_lease(robot: ToyRobot) -> None:
    line = pipeline(robot)
    served(line, "agent-a", "acquireControl")
    for verb in ("getStatus", "getFeatures", "getControl"):
        assert served(line, "agent-b", verb).result["status"] == "success"
    assert not any(verb.leased for verb in TASK_VERBS.values() if verb.name in ("stop", "releaseTorque", "getState"))


def test_take_control_stops_the_rollout_of_the_holder(robot: ToyRobot, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STRANDS_MESH_RESUME_PUBLIC_KEY", ed25519.encode(PUBLIC))
    line = pipeline(robot)
    lease_id = served(line, "agent-a", "acquireControl").result["lease_id"]
    served(line, "agent-a", "execute", instruction="wave", duration=300.0, lease_id=lease_id)
    epoch = served(line, "ann", "getControl").result["epoch"]
    answer = served(line, "ann", "takeControl", reason="wrong cup", assertion=sign_take(KEY, "arm-1", epoch)).result
    assert answer["status"] == "success"
    assert not robot.rollouts["toy"].running


def test_robots_of_a_world_are_held_one_by_one() -> None:
    world = ToyWorld()
    try:
        line = pipeline(world)
        served(line, "agent-a", "acquireControl", robot_name="left")
        refusal = served(line, "agent-b", "execute", instruction="wave", robot_name="left").refusal
        assert refusal is not None
        assert served(line, "agent-b", "execute", instruction="wave", robot_name="right").refusal is None
        reset = served(line, "agent-b", "reset")
        assert reset.refusal is not None
    finally:
        world.close()


def test_leases_of_a_robot_that_is_gone_are_gone() -> None:
    robot = ToyRobot()
    leases = leases_of(robot, hardware=False)
    assert leases_of(robot, hardware=False) is leases
    robot.close()
    assert leases_of(ToyRobot(), hardware=False) is not leases


def test_every_verb_of_the_lease_says_what_it_returns() -> None:
    assert all(verb.returns for verb in CONTROL_VERBS.values())


@pytest.mark.parametrize("ttl_s", [-1.0, 0.1, 601.0, True, "5", float("nan")])
def test_time_of_a_motion_outside_its_domain_is_refused(robot: ToyRobot, ttl_s: object) -> None:
    refusal = served(pipeline(robot), "agent-a", "execute", instruction="wave", lease_id=SECRET, lease_ttl_s=ttl_s)
    assert "lease_ttl_s" in refusal.result["content"][0]["text"]
    assert robot.answers == []


def test_time_of_a_motion_needs_a_secret(robot: ToyRobot) -> None:
    refusal = served(pipeline(robot), "agent-a", "execute", instruction="wave", lease_ttl_s=5.0)
    assert "needs a lease_id" in refusal.result["content"][0]["text"]
    assert robot.answers == []


def test_motion_of_a_caller_that_went_away_is_halted_in_its_time(robot: ToyRobot) -> None:
    line = pipeline(robot)
    begun = served(line, "agent-a", "execute", instruction="wave", duration=300.0, lease_id=SECRET, lease_ttl_s=0.5)
    assert begun.result["status"] == "success"
    eventually(lambda: not robot.rollouts["toy"].running, within=20.0, what="the halt")
    assert robot.rollouts["toy"].state == "stopped"


class Unreadable(Bench):
    """A robot whose state cannot be read."""

    def __init__(self) -> None:
        super().__init__()
        self.state: bool | Exception | None = True

    def moving(self) -> bool | None:
        """Answer, or raise, as the test has set it."""
        if isinstance(self.state, Exception):
            raise self.state
        return self.state


@pytest.mark.parametrize("state", [OSError("the bus is gone"), None, True])
def test_motion_whose_state_is_not_known_to_be_at_rest_is_halted_at_its_time(state: bool | Exception | None) -> None:
    bench = Unreadable()
    bench.lease.admit("execute", "agent-a", SECRET, 5.0).settle()
    bench.state = state
    bench.clock.now += 5.0
    bench.lease.expire()
    assert len(bench.body.halts) == 1
    assert bench.lease.due is None, "the watch would come again and again"
    assert [each.event for each in bench.changes] == ["expired"]


def test_robot_at_rest_is_not_halted_at_the_end_of_a_motions_time() -> None:
    bench = Unreadable()
    bench.lease.admit("execute", "agent-a", SECRET, 5.0).settle()
    bench.state = False
    bench.clock.now += 5.0
    bench.lease.expire()
    assert bench.body.halts == [] and bench.lease.due is None


def test_lease_ends_and_is_told_though_the_halt_failed(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(reason: str) -> None:
        raise OSError("the bus is gone")

    monkeypatch.setattr(bench.lease, "_halt", fails)
    bench.acquire(ttl_s=5.0)
    bench.clock.now += 5.0
    with pytest.raises(OSError):
        bench.lease.expire()
    assert bench.lease.due is None
    assert bench.changes[-1].event == "expired"


def test_robot_whose_state_cannot_be_read_stays_its_movers() -> None:
    bench = Unreadable()
    bench.lease.admit("moveTo", "agent-a", "").settle()
    bench.state = OSError("the bus is gone")
    assert refused(bench, "agent-b")["code"] == "not_holder"
    bench.state = None
    bench.lease.admit("moveTo", "agent-b", "").settle()


@pytest.mark.parametrize("state", ["running", "idle", "wandering", None])
def test_state_outside_the_contract_is_unknown(robot: ToyRobot, state: object, monkeypatch: pytest.MonkeyPatch) -> None:
    leases = leases_of(robot, hardware=False)
    monkeypatch.setattr(type(robot), "get_task_status", lambda self: {"task_status": state})
    assert leases._moves("") is {"running": True, "idle": False}.get(str(state))


@pytest.mark.parametrize("asked, lasts", [(2.0, 2.0), (600.0, 60.0), (0.0, 60.0)])
def test_time_of_a_motion_bounds_the_lease_that_its_caller_holds(bench: Bench, asked: float, lasts: float) -> None:
    held = bench.acquire(ttl_s=60.0)
    watched: list[float | None] = []
    bench.lease._watched = lambda lease: watched.append(lease.due)
    bench.lease.admit("execute", "agent-a", held, asked).settle()
    assert watched == ([bench.clock.now + lasts] if asked else [])
    bench.clock.now += lasts / 2
    bench.lease.renew(held)
    bench.clock.now += lasts - 0.1
    bench.lease.expire()
    assert bench.body.halts == []
    bench.clock.now += 0.1
    bench.lease.expire()
    assert len(bench.body.halts) == 1


def test_second_motion_bounds_the_time_of_the_first(bench: Bench) -> None:
    bench.lease.admit("execute", "agent-a", SECRET, 60.0).settle()
    bench.body.moves = True
    bench.lease.admit("execute", "agent-a", SECRET, 2.0).settle()
    bench.clock.now += 2.0
    bench.lease.expire()
    assert len(bench.body.halts) == 1


def test_name_of_a_caller_with_a_secret_does_not_stand_for_it(bench: Bench) -> None:
    bench.lease.admit("execute", "agent-a", SECRET, 5.0).settle()
    bench.body.moves = True
    assert refused(bench, "agent-a")["code"] == "not_holder"
    with pytest.raises(NotHolderError):
        bench.lease.refuse_others("reset", "agent-a", "")
    with pytest.raises(NotHolderError):
        bench.lease.acquire("agent-a", "agent", 60.0)
    bench.lease.refuse_others("reset", "agent-a", SECRET)
    assert bench.lease.acquire("agent-a", "agent", 60.0, SECRET)["status"] == "success"
