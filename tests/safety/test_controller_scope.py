"""A controller's stop of some robots: signed, and of every robot where none of them is there."""

from __future__ import annotations

import json
import math
import threading
import time
from collections.abc import Callable, Iterable
from typing import Any

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from fixtures.estop_orders import order_of
from fixtures.waiting import eventually

from strands_robots.device_connect.safety_controller import envelope
from strands_robots.envelope import is_error, text_of
from strands_robots.safety import ed25519
from strands_robots.safety.answers import Progress
from strands_robots.safety.controller import SafetyController
from strands_robots.safety.orders import StopOrder, StopRules
from strands_robots.safety.scope import EVERY_ROBOT, WIDEN_S, KnownRobots, Scope
from strands_robots.safety.stop_link import ESTOP, VERDICT, notification


class Fleet:
    """Link to robots that judge each sending as the real ones do, and answer it at once.

    Args:
        robots: the cell of each; None for one that reads no scope and always stops.
    """

    def __init__(self, robots: dict[str, str | None], *, up: bool = True) -> None:
        self.up = up
        self.robots = robots
        self.sent: list[tuple[float, dict[str, Any]]] = []
        self.hear: Callable[[str, str, bytes], None] = lambda event, source, payload: None
        self.on_state: Callable[[bool], None] = lambda up: None

    def open(self, events: object, hear: Callable[[str, str, bytes], None], on_state: Callable[[bool], None]) -> None:
        self.hear, self.on_state = hear, on_state

    def publish(self, source: str, event: str, payload: bytes) -> bool:
        if event != ESTOP or not self.up:
            return self.up
        params = json.loads(payload)["params"]
        self.sent.append((time.monotonic(), params))
        scope = Scope.read(params.get("scope"))
        for name, cell in self.robots.items():
            if cell is None or scope.covers(name, {cell} - {""}):
                answer = {"device_id": name, "estop_id": params["estop_id"], "stopped": True}
                answer |= {} if cell is None else {"cell": cell}
                self.hear(VERDICT, name, notification(VERDICT, answer))
        return True

    @property
    def scopes(self) -> list[Scope]:
        """The scope of each sending."""
        return [Scope.read(params.get("scope")) for _, params in self.sent]

    def close(self) -> None:
        self.up = False


@pytest.fixture
def stop(request: pytest.FixtureRequest) -> Iterable[Callable[..., Any]]:
    made: list[SafetyController] = []

    def one(fleet: Fleet, scope: Scope, expected: tuple[str, ...] = (), **options: Any) -> Any:
        within = options.pop("deadline_s", 0.6)
        on_progress = options.pop("on_progress", lambda progress: None)
        made.append(SafetyController("safety-1", lambda: fleet, **options))
        return made[-1].stop(expected, "smoke", deadline_s=within, scope=scope, on_progress=on_progress)

    yield one
    for each in made:
        each.close()


def test_stop_of_one_robot_is_signed_and_ends_with_its_answer(stop: Callable[..., Any]) -> None:
    key, fleet = Ed25519PrivateKey.generate(), Fleet({"arm-1": "", "arm-2": ""})
    report = stop(fleet, Scope.named(["arm-1"]), signing_key=key, deadline_s=20)
    assert report.ok and not report.widened
    assert set(report.stopped) == {"arm-1"}
    rules = StopRules(allow=(), keys=(ed25519.public_half(key),))
    order = order_of(rules, "safety-1", notification(ESTOP, fleet.sent[0][1]))
    assert isinstance(order, StopOrder)
    assert order.scope == report.scope == Scope.named(["arm-1"])
    answer = envelope(report)
    assert (answer["status"], answer["scope"]) == ("success", {"only": ["arm-1"]})


def test_named_robot_that_is_silent_is_missed_beside_one_that_answers(stop: Callable[..., Any]) -> None:
    report = stop(Fleet({"arm-1": ""}), Scope.named(["arm-1", "arm-9"]))
    assert report.silent == ("arm-9",)
    assert not (report.ok or report.widened)


@pytest.mark.parametrize("scope", [Scope.named(["arm-9"]), Scope(cell="cell-9")], ids=str)
def test_stop_for_nobody_that_is_there_becomes_one_of_every_robot(
    stop: Callable[..., Any], scope: Scope, caplog: pytest.LogCaptureFixture
) -> None:
    fleet, seen = Fleet({"arm-1": "cell-1", "nowhere": "", "older": None}), list[Progress]()
    report = stop(fleet, scope, on_progress=seen.append)
    assert report.widened and not report.ok
    assert set(report.stopped) == {"arm-1", "nowhere", "older"}
    assert fleet.scopes[0] == scope and fleet.scopes[-1] == EVERY_ROBOT
    assert len({params["estop_id"] for _, params in fleet.sent}) == 1
    first_wide = next(at for at, params in fleet.sent if "scope" not in params)
    assert first_wide - fleet.sent[0][0] >= WIDEN_S
    assert seen[-1].widened and not seen[0].widened
    assert "EVERY ROBOT IS STOPPED" in caplog.text
    answer = envelope(report)
    assert is_error(answer) and answer["widened"] is True
    assert "every robot was stopped" in text_of(answer)


def test_answers_of_robots_without_a_cell_do_not_hide_a_mistyped_one(stop: Callable[..., Any]) -> None:
    fleet = Fleet({"free-1": "", "moving-1": "cell-1"})
    report = stop(fleet, Scope(cell="cell-l"), ("free-1",), deadline_s=20)
    assert report.widened and not report.ok
    assert "moving-1" in report.stopped
    # The stop of every robot is repeated: one message may be lost.
    assert fleet.scopes.count(EVERY_ROBOT) > 1


def test_disk_that_has_not_answered_in_time_knows_no_robot() -> None:
    answers = threading.Event()
    known = KnownRobots(Scope(cell="cell-1"), lambda asked: answers.wait(60))
    assert known.widens_after_s == WIDEN_S
    answers.set()
    eventually(lambda: known.widens_after_s == math.inf)


def test_disk_that_answers_once_every_robot_was_stopped_undoes_nothing(stop: Callable[..., Any]) -> None:
    fleet = Fleet({"free-1": ""})

    def read_slowly(asked: Scope) -> bool:
        eventually(lambda: EVERY_ROBOT in fleet.scopes)
        return True

    report = stop(fleet, Scope(cell="cell-1"), ("free-1",), deadline_s=20, remembers=read_slowly)
    assert report.widened and not report.ok


def test_disk_that_hangs_widens_the_stop_all_the_same(stop: Callable[..., Any]) -> None:
    hangs = threading.Event()
    try:
        report = stop(
            Fleet({"arm-1": ""}), Scope.named(["arm-9"]), deadline_s=1, remembers=lambda asked: hangs.wait(60)
        )
    finally:
        hangs.set()
    assert report.widened and set(report.stopped) == {"arm-1"}


def test_remembered_cell_ends_with_the_answers_of_robots_without_one(stop: Callable[..., Any]) -> None:
    fleet = Fleet({"free-1": ""})
    report = stop(fleet, Scope(cell="cell-1"), ("free-1",), deadline_s=20, remembers=lambda asked: True)
    assert report.ok and not report.widened


def test_stop_that_left_just_before_its_deadline_widens_all_the_same(stop: Callable[..., Any]) -> None:
    fleet = Fleet({"arm-1": "cell-1"}, up=False)
    back = threading.Timer(0.55, lambda: (setattr(fleet, "up", True), fleet.on_state(True)))
    back.start()
    report = stop(fleet, Scope(cell="cell-l"), deadline_s=0.6)
    back.join()
    assert report.widened or not report.link


def test_known_robot_that_is_silent_keeps_the_stop_to_itself(stop: Callable[..., Any]) -> None:
    fleet, scope = Fleet({"arm-2": ""}), Scope.named(["arm-1"])
    report = stop(fleet, scope, remembers=lambda asked: asked == scope)
    assert (report.silent, report.widened) == (("arm-1",), False)
    assert set(fleet.scopes) == {scope}


def test_robots_that_cannot_be_read_count_as_not_known(stop: Callable[..., Any]) -> None:
    gate = threading.Event()

    def hangs(scope: Scope) -> bool:
        gate.wait(20)
        return True

    def fails(scope: Scope) -> bool:
        raise OSError("no such file")

    assert stop(Fleet({"arm-2": ""}), Scope.named(["arm-1"]), remembers=hangs).widened
    gate.set()
    assert stop(Fleet({"arm-2": ""}), Scope.named(["arm-1"]), remembers=fails).widened


def test_widening_waits_until_the_stop_has_left(stop: Callable[..., Any]) -> None:
    fleet = Fleet({"arm-1": ""}, up=False)
    assert not stop(fleet, Scope.named(["arm-9"])).widened
    back = threading.Timer(0.3, lambda: (setattr(fleet, "up", True), fleet.on_state(True)))
    back.start()
    report = stop(fleet, Scope.named(["arm-9"]), deadline_s=2)
    back.join()
    assert report.widened
    assert fleet.scopes[0] == Scope.named(["arm-9"])


def test_short_deadline_leaves_time_for_every_robot(stop: Callable[..., Any]) -> None:
    report = stop(Fleet({"arm-1": ""}), Scope.named(["arm-9"]), deadline_s=0.01)
    assert report.widened and set(report.stopped) == {"arm-1"}


def test_claimed_answer_for_an_enrolled_robot_is_no_answer_of_it(stop: Callable[..., Any]) -> None:
    key = ed25519.public_half(Ed25519PrivateKey.generate())
    report = stop(Fleet({"arm-1": "", "arm-2": ""}), Scope.named(["arm-1"]), enrolled=lambda: {"arm-1": key})
    assert report.widened and "arm-1" in report.claimed


def test_stop_of_every_robot_has_no_scope(stop: Callable[..., Any]) -> None:
    fleet = Fleet({"arm-1": "cell-1"})
    report = stop(fleet, EVERY_ROBOT, ("arm-1",), deadline_s=20)
    assert report.ok and "scope" not in envelope(report)
    assert all("scope" not in params and "scope_sig" not in params for _, params in fleet.sent)


def test_stranger_in_a_mistyped_scope_does_not_keep_the_others_moving(stop: Callable[..., Any]) -> None:
    key = ed25519.public_half(Ed25519PrivateKey.generate())
    fleet = Fleet({"stranger": "cell-9"})
    report = stop(fleet, Scope(cell="cell-9"), enrolled=lambda: {"arm-1": key})
    assert report.widened
    assert fleet.scopes[-1] == EVERY_ROBOT
    assert not report.ok
