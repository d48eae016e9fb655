"""The plane frees robots: by the operator's signature, or at their own machine."""

from __future__ import annotations

import json
import os
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from fixtures.recording_robot import RecordingRobot
from fixtures.waiting import eventually

from strands_robots.audit import read_audit_log
from strands_robots.envelope import is_error
from strands_robots.safety import ed25519, resume
from strands_robots.safety.orders import StopOrder, new_epoch
from strands_robots.safety.persistence import LockoutStore
from strands_robots.safety.plane import SafetyPlane
from strands_robots.safety.resume import sign
from strands_robots.state_files import boot, uptime

Add = Callable[..., RecordingRobot]


def order(epoch: str = "", source: str = "safety-1", **fields: Any) -> StopOrder:
    return StopOrder(epoch or new_epoch(), source, fields.pop("reason", "smoke"), **fields)


@pytest.fixture
def operator(monkeypatch: pytest.MonkeyPatch) -> Ed25519PrivateKey:
    key = Ed25519PrivateKey.generate()
    monkeypatch.setenv("STRANDS_MESH_RESUME_PUBLIC_KEY", ed25519.encode(ed25519.public_half(key)))
    return key


def test_two_stops_need_two_resumes_and_a_resume_starts_nothing(
    plane: SafetyPlane, add: Add, operator: Ed25519PrivateKey
) -> None:
    robot = add()
    robot.start()
    epochs = [new_epoch(), new_epoch()]
    for epoch in epochs:
        plane.emergency_stop(order(epoch))
    for left, epoch in ((True, epochs[0]), (False, epochs[1])):
        answer = plane.resume("arm-1", sign(operator, epoch, ["arm-1"])[0], "test")
        assert not is_error(answer)
        assert answer["locked"] is left
        assert robot.refuses() is left
    writes = len(robot.device.times)
    time.sleep(0.03)
    assert len(robot.device.times) == writes
    robot.start()
    assert robot.moving


def test_a_rejected_resume_says_nothing_on_the_wire_and_why_in_the_audit(
    plane: SafetyPlane, add: Add, operator: Ed25519PrivateKey
) -> None:
    robot, epoch = add(), new_epoch()
    plane.emergency_stop(order(epoch))
    answer = plane.resume("arm-1", sign(operator, epoch, ["arm-2"])[0], "mesh")
    assert answer["reason"] == "resume rejected"
    assert robot.refuses()
    denied = [each for each in read_audit_log() if each["event"] == "resume_denied"]
    assert "targets" in denied[0]["payload"]["why"]
    assert is_error(plane.resume("nobody", {}, "mesh"))


def test_a_local_clear_frees_names_who_and_survives_a_restart(plane: SafetyPlane, add: Add) -> None:
    robot = add(key="k")
    plane.emergency_stop(order())
    assert list(plane.clear_local("ann")) == ["arm-1"]
    assert not robot.refuses()
    assert not LockoutStore().load("k").state.locked
    assert [each["payload"]["who"] for each in read_audit_log() if each["event"] == "resume_local"] == ["ann"]


def test_order_at_the_machine_clears_the_robot_it_names(plane: SafetyPlane, add: Add) -> None:
    robots = {name: add(name) for name in ("arm-1", "arm-2")}
    plane.emergency_stop(order())
    resume.order_clearance("ann", ["arm-1"])
    eventually(lambda: not robots["arm-1"].refuses())
    assert robots["arm-2"].refuses()
    eventually(lambda: [each.suffix for each in resume.clearances().iterdir()] == [".said"])


def test_clearing_at_the_machine_reaches_a_running_robot_one_that_is_off_and_says_of_a_third_that_it_is_free(
    plane: SafetyPlane, add: Add
) -> None:
    running = add("arm-1", key="k1")
    add("arm-2", key="k2")
    plane.emergency_stop(order())
    plane.robots["arm-2"].close()
    assert resume.clear_here("ann", ["arm-1"], wait_s=20) == {"arm-1": "cleared"}
    assert not running.refuses(), "what is told to be cleared is"
    plane.emergency_stop(order())
    # No process takes the orders of the others, which are waited for to the end.
    outcome = resume.clear_here("ann", ["arm-2", "arm-3"], wait_s=0.1)
    assert outcome == {"arm-2": "cleared on disk", "arm-3": "not locked here"}
    assert running.refuses()
    after = add("arm-2", key="k2")
    assert not after.refuses()
    cleared = [each for each in read_audit_log() if each["event"] == "resume_local"]
    assert {each["peer_id"] for each in cleared} == {"arm-1", "arm-2"}


class SlowProcess:
    """A process that takes every order for ``arm-1`` and carries it out when it is let go."""

    def __init__(self) -> None:
        self.doing, self.go_on = threading.Event(), threading.Event()
        self._inbox = resume.ClearanceInbox(lambda: ["arm-1"], self._clear)
        self._thread = threading.Thread(target=lambda: eventually(self._took, within=60))

    def _clear(self, who: str, name: str) -> str:
        self.doing.set()
        self.go_on.wait()
        return "cleared"

    def _took(self) -> bool:
        self._inbox.look(0.0)
        return self.doing.is_set()

    def __enter__(self) -> SlowProcess:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.go_on.set()
        self._thread.join()


def test_cleared_is_answered_once_the_process_has_done_it() -> None:
    answers: list[dict[str, str]] = []
    asking = threading.Thread(target=lambda: answers.append(resume.clear_here("ann", ["arm-1"], wait_s=30)))
    with SlowProcess() as process:
        asking.start()
        assert process.doing.wait(20)
        asking.join(0.2)
        assert answers == []
        process.go_on.set()
        asking.join()
    assert answers == [{"arm-1": "cleared"}]


def test_order_that_is_not_carried_out_is_not_reported_as_cleared() -> None:
    with SlowProcess():
        answers = resume.clear_here("ann", ["arm-1"], wait_s=2.0)
    assert "has not carried it out" in answers["arm-1"]
    assert list(resume.clearances().iterdir()) == []


def test_order_from_another_time_is_void_and_not_reported_as_cleared(
    plane: SafetyPlane, add: Add, monkeypatch: pytest.MonkeyPatch
) -> None:
    def order_an_hour_ago(who: str, names: list[str]) -> list[Path]:
        resume.clearances().mkdir(mode=0o700, parents=True)
        order = resume.clearances() / "a.draft"
        order.write_text(
            json.dumps({"who": who, "robot_id": names[0], "boot": boot(), "t": uptime() - 3600}), encoding="utf-8"
        )
        return [order.replace(order.with_suffix(".json"))]

    monkeypatch.setattr(resume, "order_clearance", order_an_hour_ago)
    robot = add()
    plane.emergency_stop(order())
    assert "nothing was cleared" in resume.clear_here("ann", ["arm-1"], wait_s=20)["arm-1"]
    assert robot.refuses()


def test_running_robot_that_is_not_locked_is_not_reported_as_cleared(plane: SafetyPlane, add: Add) -> None:
    add("arm-1")
    add("arm-2")
    plane.emergency_stop(order())
    plane.clear_local("bob", ["arm-1"])
    assert resume.clear_here("ann", ["arm-1"], wait_s=20) == {"arm-1": "not locked here"}


def test_robot_that_leaves_before_its_order_is_not_reported_as_cleared(
    plane: SafetyPlane, add: Add, monkeypatch: pytest.MonkeyPatch
) -> None:
    clear = plane.clear_local

    def too_late(who: str, names: list[str]) -> object:
        plane.robots["arm-1"].close()
        return clear(who, names)

    monkeypatch.setattr(plane, "clear_local", too_late)
    robot = add("arm-1")
    add("arm-2")
    plane.emergency_stop(order())
    assert "left its process" in resume.clear_here("ann", ["arm-1"], wait_s=20)["arm-1"]
    assert robot.refuses()


def test_robot_whose_clearance_was_not_stored_is_free_and_that_is_reported(
    plane: SafetyPlane, add: Add, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = add(key="k")
    plane.emergency_stop(order())

    def full(kept: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(plane.store, "save", full)
    answers = resume.clear_here("ann", ["arm-1"], wait_s=20)["arm-1"]
    assert answers == "cleared, but not kept on the disk: after a restart it may be locked again"
    assert not robot.refuses()
    assert LockoutStore().load("k").state.locked


def test_unfinished_orders_are_removed_after_a_minute(plane: SafetyPlane, add: Add) -> None:
    add()
    directory = resume.clearances()
    directory.mkdir(mode=0o700, parents=True)
    old = [directory / name for name in ("a.taken", "b.draft", "c.said")]
    young = directory / "d.taken"
    for path in (*old, young):
        path.touch()
    long_ago = time.time() - 2 * resume.VALID_S
    for path in old:
        os.utime(path, (long_ago, long_ago))
    plane.emergency_stop(order())
    eventually(lambda: list(directory.iterdir()) == [young])


def test_order_directory_that_others_may_write_is_not_read(plane: SafetyPlane, add: Add) -> None:
    robot = add()
    plane.emergency_stop(order())
    resume.order_clearance("ann", ["arm-1"])
    resume.clearances().chmod(0o777)
    time.sleep(0.6)
    assert robot.refuses()
