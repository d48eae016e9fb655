"""Stops of large processes: the order of halts and answers."""

from __future__ import annotations

import gc
import json
import math
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from fixtures.estop_orders import order_of
from fixtures.recording_robot import RecordingRobot
from fixtures.waiting import eventually

from strands_robots.safety import controller as controller_module
from strands_robots.safety import estop_listener, reporting
from strands_robots.safety.controller import SafetyController
from strands_robots.safety.estop_listener import EstopListener
from strands_robots.safety.orders import (
    ANSWERED,
    ANSWERED_MAX_BYTES,
    LISTENER,
    RobotReport,
    StopOrder,
    StopRules,
    answered_field,
    new_epoch,
)
from strands_robots.safety.plane import Registered, SafetyPlane
from strands_robots.safety.reporting import Reporter, StopRun
from strands_robots.safety.stop_link import VERDICT, notification
from strands_robots.safety.stopping import StopVerdict

Add = Callable[..., RecordingRobot]


class RepeatingLink:
    """Robots that answer one after the other: one more at each sending, and ``before`` the first all of these."""

    def __init__(self, names: list[str], before: list[str] | None = None, **fields: Any) -> None:
        self.up = True
        self.sent: list[dict[str, Any]] = []
        self.payloads: list[bytes] = []
        self._names, self._before, self._fields = names, before or [], fields
        self._hear: Callable[[str, str, bytes], None] = lambda event, source, payload: None

    def open(self, events: object, hear: Callable[[str, str, bytes], None], on_state: object) -> None:
        self._hear = hear

    def publish(self, source: str, event: str, payload: bytes) -> bool:
        self.payloads.append(payload)
        self.sent.append(json.loads(payload)["params"])
        before, self._before = self._before, []
        for name in [*before, *self._names[len(self.sent) - 1 : len(self.sent)]]:
            answer = {"device_id": name, "estop_id": self.sent[0]["estop_id"], "stopped": True, **self._fields}
            self._hear(VERDICT, name, notification(VERDICT, answer))
        return True

    def close(self) -> None:
        self.up = False


def order(answered: tuple[str, ...] = (), epoch: str = "") -> StopOrder:
    return StopOrder(epoch or new_epoch(), "safety-1", "smoke", answered=frozenset(answered))


def test_each_repetition_names_the_robots_that_have_answered() -> None:
    names = ["arm-1", "arm-2", "arm-3"]
    link = RepeatingLink(names)
    assert SafetyController("safety-1", lambda: link).stop(names, deadline_s=20).ok
    assert [set(each.get(ANSWERED, ())) for each in link.sent[:3]] == [set(), {"arm-1"}, {"arm-1", "arm-2"}]


@pytest.mark.parametrize("fields", [{"stopped": False}, {"stopped": None}, {"persisted": False}])
def test_a_robot_that_has_more_to_say_is_asked_again(fields: dict[str, Any]) -> None:
    link = RepeatingLink(["arm-1", "arm-2"], **fields)
    SafetyController("safety-1", lambda: link).stop(["arm-1", "arm-2"], deadline_s=20)
    assert len(link.sent) >= 2
    assert all(ANSWERED not in each for each in link.sent)


def test_a_robot_whose_answer_is_there_does_not_repeat_it(plane: SafetyPlane, add: Add) -> None:
    add("arm-1"), add("arm-2")
    first, repeated = order(), []
    assert plane.emergency_stop(first).keys() == {"arm-1", "arm-2"}
    plane.begin(order(("arm-1",), first.epoch), lambda report: repeated.append(report.robot_id))
    assert repeated == ["arm-2"]


def test_a_robot_that_did_not_stop_says_so_at_each_repetition(
    plane: SafetyPlane, add: Add, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STRANDS_HALT_DEADLINE_S", "0.1")
    release, repeated = threading.Event(), []
    add("arm-1", before_halt=lambda: release.wait(60))
    first = order()
    assert plane.emergency_stop(first)["arm-1"].stopped is False
    plane.begin(order(("arm-1",), first.epoch), lambda report: repeated.append(report.robot_id))
    assert repeated == ["arm-1"]
    release.set()


def test_a_robot_whose_lockout_is_not_kept_says_so_at_each_repetition(
    plane: SafetyPlane, add: Add, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(kept: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(plane.store, "save", full)
    add("arm-1", key="k")
    first, repeated = order(), list[RobotReport]()
    assert plane.emergency_stop(first)["arm-1"].persisted is False
    plane.begin(order(("arm-1",), first.epoch), repeated.append)
    assert [(each.robot_id, each.stopped, each.persisted) for each in repeated] == [("arm-1", True, False)]


def test_a_robot_that_is_named_as_answered_is_halted_by_a_stop_that_it_has_not_seen(
    plane: SafetyPlane, add: Add
) -> None:
    robot = add("arm-1")
    assert plane.emergency_stop(order(("arm-1",)))["arm-1"].stopped is True
    assert robot.refuses()


@pytest.mark.parametrize("stated", [None, "arm-1", 3, {"arm-1": 1}, [["arm-1"], None, 3]])
def test_a_stop_counts_whatever_it_names_as_answered(stated: object) -> None:
    decided = StopRules(allow=(), keys=()).order("safety-1", {"estop_id": new_epoch(), ANSWERED: stated}, "lane")
    assert isinstance(decided, StopOrder)
    assert decided.answered == frozenset()


@pytest.mark.parametrize("letter", ["a", "\N{LATIN SMALL LETTER E WITH ACUTE}", "\N{ROBOT FACE}", '"', "\ud83e"])
def test_the_names_of_those_that_answered_are_bounded_as_encoded(letter: str) -> None:
    names = [f"{letter * 20}-{number:05}" for number in range(20_000)]
    named = answered_field(names)[ANSWERED]
    assert ANSWERED_MAX_BYTES * 0.9 < len(json.dumps(named)) <= ANSWERED_MAX_BYTES
    assert answered_field([]) == {}


def test_one_name_that_is_too_long_displaces_no_other() -> None:
    assert answered_field(["arm-1", "a" * ANSWERED_MAX_BYTES, "arm-2"]) == {ANSWERED: ["arm-1", "arm-2"]}


@pytest.mark.parametrize("letter", ["a", "\N{ROBOT FACE}"])
def test_answers_in_600_invented_names_keep_no_repetition_from_being_read(letter: str) -> None:
    invented, rules = [f"{letter * 60}-{number}" for number in range(600)], StopRules(allow=(), keys=())
    link = RepeatingLink(["arm-1", "arm-2", "arm-3"], before=invented)
    controller = SafetyController("safety-1", lambda: link)
    assert controller.stop(["arm-1", "arm-2", "arm-3"], "\N{ROBOT FACE}" * 200, deadline_s=20).ok
    assert len(link.sent) >= 3
    for number, payload in enumerate(link.payloads):
        read = order_of(rules, "safety-1", payload)
        assert isinstance(read, StopOrder)
        assert read.epoch == link.sent[0]["estop_id"]
        assert read.answered >= {"arm-1", "arm-2"} or number < 2


@pytest.mark.parametrize(("key", "unused"), [(None, "SIGNED_MAX_S"), (Ed25519PrivateKey.generate(), "MAX_S")])
def test_many_expected_robots_that_do_not_exist_delay_no_repetition_for_long(
    key: Ed25519PrivateKey | None, unused: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert controller_module.REPEAT_EACH_MAX_S <= 0.05
    assert controller_module.REPEAT_EACH_SIGNED_MAX_S <= 0.02
    monkeypatch.setattr(controller_module, "REPEAT_EACH_S", 1000.0)
    monkeypatch.setattr(controller_module, f"REPEAT_EACH_{unused}", 1000.0)
    names = ["arm-1", "arm-2", "arm-3"]
    link = RepeatingLink(names)
    assert SafetyController("safety-1", lambda: link, signing_key=key).stop(names, deadline_s=20).ok


def test_a_robot_of_a_large_process_answers_a_repetition_after_a_quarter_of_a_second(
    plane: SafetyPlane, add: Add, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(estop_listener, "ANSWER_AGAIN_EACH_S", 3600.0)
    add("arm-1")
    listener, link, stop = EstopListener(plane, lambda: StopRules(allow=(), keys=())), RepeatingLink([]), order()
    registration = listener.register("arm-1", "net", lambda: link)
    try:
        listener.stop_here(stop)
        eventually(lambda: len(link.sent) == 1)
        eventually(lambda: listener.stop_here(stop) or len(link.sent) == 2)
        assert [each["repeated"] for each in link.sent] == [False, True]
        assert estop_listener.ANSWER_AGAIN_MAX_S <= 0.25
    finally:
        listener.unregister(registration)


@dataclass
class PacedRun:
    """A stop of four robots whose *stopped* is not due until the test says so."""

    reporter: Reporter
    run: StopRun
    events: list[str]

    def answer(self, robot_id: str, **verdict: Any) -> None:
        self.reporter.answer(self.run, robot_id, StopVerdict(**verdict))


@pytest.fixture
def paced() -> Iterator[PacedRun]:
    names, events, reporter = ("arm-0", "arm-1", "arm-2", "arm-3"), list[str](), Reporter()
    run = StopRun(
        order(),
        names,
        frozenset(names),
        20.0,
        lambda name: (),
        lambda report: events.append(report.robot_id),
        lambda done: events.append("done"),
        lambda: events.append("file"),
    )
    run.answer_at = math.inf
    reporter.begin(run)
    yield PacedRun(reporter, run, events)
    reporter.close()


def test_a_large_process_writes_its_lockouts_before_its_answers_are_due(paced: PacedRun) -> None:
    for name in paced.run.robot_ids:
        paced.answer(name, halted=("task",))
    eventually(lambda: paced.run.kept is True)
    assert paced.events == ["file"]
    paced.run.answer_at = 0.0
    eventually(lambda: "done" in paced.events)
    assert paced.events == ["file", *paced.run.robot_ids, "done"]


def test_a_large_process_writes_its_lockouts_though_a_halt_has_not_answered(paced: PacedRun) -> None:
    paced.answer("arm-0", halted=("task",))
    eventually(lambda: paced.run.kept is True)
    assert paced.events == ["file"]


def test_lockouts_of_a_large_process_wait_until_other_processes_have_halted_theirs(paced: PacedRun) -> None:
    paced.run.keep_at = math.inf
    for name in paced.run.robot_ids:
        paced.answer(name, halted=("task",))
    eventually(lambda: len(paced.run.answers) == 4)
    assert paced.events == []
    paced.run.keep_at = 0.0
    eventually(lambda: paced.run.kept is True)


def test_lockouts_of_a_large_process_are_written_at_once_where_a_robot_did_not_stop(paced: PacedRun) -> None:
    paced.run.keep_at = math.inf
    for name in paced.run.robot_ids:
        paced.answer(name, not_stopped={"bus": "no answer in 1 s"})
    eventually(lambda: paced.run.kept is True)


def test_the_collector_waits_for_the_halts_of_a_stop_and_no_longer(
    plane: SafetyPlane, add: Add, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reporting, "GRACE_S", 60.0)
    during = list[bool]()
    add("arm-1", before_halt=lambda: during.append(gc.isenabled()))
    eventually(gc.isenabled)
    assert plane.emergency_stop(order())["arm-1"].stopped is True
    assert during == [False]
    eventually(gc.isenabled)


def test_the_collector_goes_on_while_answers_to_another_stop_are_sent(plane: SafetyPlane, add: Add) -> None:
    sending, release = threading.Event(), threading.Event()

    def slow(report: RobotReport) -> None:
        sending.set()
        release.wait(60)

    add("arm-1")
    assert plane.begin(order(), slow) is not None
    try:
        assert sending.wait(20)
        assert plane.begin(order()) is not None
        eventually(gc.isenabled)
    finally:
        release.set()


def test_the_collector_goes_on_while_a_halt_blocks(plane: SafetyPlane, add: Add) -> None:
    release = threading.Event()
    add("arm-1", before_halt=lambda: release.wait(60))
    run = plane.begin(order())
    try:
        assert run is not None
        eventually(gc.isenabled)
        assert not run.done.is_set()
    finally:
        release.set()


def test_a_repetition_while_the_halts_are_under_way_is_not_read_robot_by_robot(plane: SafetyPlane, add: Add) -> None:
    release, first = threading.Event(), order()
    robot = add("arm-1", before_halt=lambda: release.wait(60))
    assert plane.begin(first) is not None
    try:
        assert plane.under_way(first.epoch)
        assert not plane.under_way(new_epoch())
        assert plane.begin(order((), first.epoch)) is None
        late = add("arm-2")
        assert not plane.under_way(first.epoch)
        assert plane.begin(order((), first.epoch)) is not None
        assert late.refuses() and robot.refuses()
    finally:
        release.set()
    eventually(lambda: not plane.under_way(first.epoch))


def test_a_stop_over_a_second_path_asks_no_robot_that_the_first_one_has_still_to_lock(
    plane: SafetyPlane, add: Add, monkeypatch: pytest.MonkeyPatch
) -> None:
    robots = [add(f"arm-{number}") for number in range(3)]
    first, asked = order(), list[str]()
    locking, ended = threading.Event(), threading.Event()
    runs, reports = list[StopRun | None](), list[RobotReport]()
    listener = threading.Thread(
        target=lambda: runs.append(plane.begin(replace(first, path=LISTENER), reports.append)), name="listener"
    )

    def let_the_listener_in() -> None:
        if not listener.is_alive():
            listener.start()
            assert locking.wait(20)

    def wait_for_the_other_path() -> None:
        locking.set()
        assert ended.wait(20)

    def note(entry: Registered, again: StopOrder) -> None:
        if threading.current_thread() is not listener:
            asked.append(entry.robot_id)

    noted = {id(robots[0]): let_the_listener_in, id(robots[1]): wait_for_the_other_path}
    kind = type(robots[0])
    monkeypatch.setattr(kind, "halt_ordered", lambda robot: noted.get(id(robot), lambda: None)(), raising=False)
    monkeypatch.setattr(Registered, "report_again", note)
    runs.append(plane.begin(first, reports.append))
    ended.set()
    listener.join(20)
    assert all(run is not None and run.wait(20) for run in runs)
    assert asked == []
    assert sorted((each.robot_id, each.stopped) for each in reports) == [(f"arm-{each}", True) for each in range(3)]


@pytest.mark.parametrize("verdict", [{"not_stopped": {"bus": "no answer in 1 s"}}, {"unknown": {"arm-2": "unknown"}}])
def test_a_robot_of_a_large_process_that_did_not_stop_says_so_at_once(
    paced: PacedRun, verdict: dict[str, dict[str, str]]
) -> None:
    for name in ("arm-0", "arm-1", "arm-3"):
        paced.answer(name, halted=("task",))
    paced.answer("arm-2", **verdict)
    eventually(lambda: "arm-2" in paced.events)
    assert paced.events == ["file", "arm-2"]
    paced.run.answer_at = 0.0
    eventually(lambda: "done" in paced.events)
    assert paced.events == ["file", "arm-2", "arm-0", "arm-1", "arm-3", "done"]


@pytest.mark.parametrize(("count", "shortest", "longest"), [(32, 0.0, 0.0), (33, 0.033, 0.066), (5000, 0.1, 0.2)])
def test_answers_are_held_back_for_a_fifth_of_a_second_at_most(count: int, shortest: float, longest: float) -> None:
    def nothing(*given: object) -> None:
        pass

    names = tuple(f"arm-{number}" for number in range(count))
    for _ in range(100):
        run = StopRun(order(), names, frozenset(), 1.0, lambda name: (), nothing, nothing, nothing)
        assert shortest - 1e-6 <= run.answer_at - run.started <= longest + 1e-6
