"""A recording as a device: who may say a word, and what a lockout and a lease are to it."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from fixtures.waiting import eventually

from strands_robots.cli import recorder_device
from strands_robots.cli.network import Network
from strands_robots.cli.output import Screen
from strands_robots.cli.recorder_device import RecorderDevice, grant_page, recorder_driver, recorder_served
from strands_robots.cli.recording_state import RecordingState, Said, Stage
from strands_robots.safety.lockout import LockoutLatch
from strands_robots.safety.orders import COMES_UP_LOCKED
from strands_robots.safety.scope import Scope


class Bench:
    """A recording that runs, and its driver, which is called as by a network."""

    def __init__(self) -> None:
        self.state = RecordingState()
        self.device = RecorderDevice(self.state, "arm-1", "wave")
        self.driver = recorder_driver(self.device, "recorder-arm-1")
        grant_page(self.driver.peer_id)
        self.state.enter(Stage.RECORDING)

    def call(self, verb: str, caller: str | None = "dashboard", **arguments: object) -> dict[str, Any]:
        answer: dict[str, Any] = asyncio.run(self.driver.invoke(verb, source_device=caller, **arguments))
        return answer


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_page_alone_may_say_a_word_where_nobody_else_is_named(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    for other in ("agent-1", "strands-robots", None):
        refused = bench.call("endRecording", other)
        assert (refused["status"], "DEVICE_CONNECT_RPC_ALLOW" in refused["reason"]) == ("error", True)
        assert bench.call("getRecording", other)["state"] == "recording", "every caller may look"
    assert bench.state.words.said() is None
    monkeypatch.setenv("DEVICE_CONNECT_RPC_ALLOW", "agent-*")
    assert bench.call("endRecording")["status"] == "error"
    assert bench.call("endRecording", "agent-1")["status"] == "success"
    assert bench.state.words.said() is Said.END


def test_begin_is_a_motion_that_is_approved_for_the_page_alone(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DEVICE_CONNECT_RPC_ALLOW", "*,anonymous")
    bench.state.wait_for_begin(None)
    for other in ("agent-1", "mcp", "my-dashboard-1", None):
        refused = bench.call("beginEpisode", other)
        assert (refused["status"], "needs operator approval" in refused["reason"]) == ("error", True)
    assert bench.state.words.said() is None
    for page in ("dashboard", "dashboard-0a1b2c3d", "desk__dashboard-0a1b2c3d"):
        assert bench.call("beginEpisode", page)["status"] == "success"
        assert bench.state.words.said() is Said.SUCCESS
        bench.state.wait_for_begin(None)
    assert bench.call("endRecording", "agent-1")["status"] == "success", "a word that moves nothing needs none"


def test_begin_is_refused_while_another_holds_the_recorder(bench: Bench) -> None:
    bench.state.wait_for_begin(None)
    leases = bench.driver.pipeline.leases
    assert leases is not None
    leases.of().acquire("alice", "human", 10.0)
    assert "alice (human) holds control" in bench.call("beginEpisode")["reason"]
    assert bench.state.words.said() is None


@pytest.mark.parametrize("given", [{}, {"success": 1}, {"success": "yes"}, {"success": True, "episode": 3}])
def test_worth_that_is_none_is_refused_by_name(bench: Bench, given: dict[str, object]) -> None:
    refused = bench.call("keepEpisode", **given)
    assert refused["status"] == "error"
    assert "success" in refused["reason"]
    assert bench.state.words.said() is None


def test_locked_recorder_begins_nothing_and_ends_what_its_robot_does_not(bench: Bench) -> None:
    latch = LockoutLatch("recorder-arm-1")
    bench.driver.robot.gate.attach(latch)
    latch.engage("e" * 32, "desk", "smoke")
    ends: list[str] = []
    watcher = threading.Thread(
        target=lambda: (
            eventually(lambda: bench.state.halting),
            ends.append(bench.state.halted),
            eventually(lambda: bench.state.halted, what="the end of the attempt"),
            bench.state.enter(Stage.SAVING),
        )
    )
    watcher.start()
    verdict = bench.driver.robot.halt("emergency stop of desk")
    watcher.join(10)
    assert ends == [""], "the robot's own stop is seen first, where it is stopped as well"
    assert verdict.stopped, "once the attempt is over"
    bench.state.wait_for_begin(None)
    refused = bench.call("beginEpisode")
    assert (refused["status"], refused["locked"]) == ("error", True)
    assert bench.state.words.said() is None


def test_stop_of_one_recorder_waits_for_no_robot_that_an_older_stop_has_locked(bench: Bench) -> None:
    latch = LockoutLatch("recorder-arm-1")
    bench.driver.robot.gate.attach(latch)
    latch.engage("e" * 32, "desk", "smoke")
    bench.device.halt("emergency stop of desk")
    assert bench.state.halted == ""
    bench.device.halt("stop by desk")
    assert bench.state.halted == "the recording was stopped: stop by desk"


def test_begin_of_a_recorder_that_was_locked_before_is_named_to_the_terminal(bench: Bench) -> None:
    assert bench.state.refusal == ""
    latch = LockoutLatch("recorder-arm-1")
    bench.driver.robot.gate.attach(latch)
    latch.engage("e" * 32, "desk", "smoke")
    bench.device.halt(COMES_UP_LOCKED)
    assert bench.state.halting == "", "it waits for the resume"
    assert bench.state.refusal.startswith("recorder-arm-1 is locked by the emergency stop of desk")
    bench.device.halt("".join(COMES_UP_LOCKED.partition("up")))
    assert bench.state.halting.endswith(COMES_UP_LOCKED), "a stop that says so is one"


def test_emergency_stop_of_the_recorder_alone_ends_the_attempt_at_once(bench: Bench) -> None:
    latch = LockoutLatch("recorder-arm-1")
    bench.driver.robot.gate.attach(latch)
    latch.engage("e" * 32, "desk", "smoke", Scope.named(["recorder-arm-1"]))
    verdict = bench.driver.robot.halt("emergency stop of desk")
    assert bench.state.halted
    assert verdict.stopped is False, "its robot is not halted yet"


def test_locked_recorder_ends_all_the_same_and_asks_for_no_lease(bench: Bench) -> None:
    latch = LockoutLatch("recorder-arm-1")
    bench.driver.robot.gate.attach(latch)
    latch.engage("e" * 32, "desk", "smoke")
    leases = bench.driver.pipeline.leases
    assert leases is not None
    leases.of().acquire("other", "agent", 10.0)
    assert leases.facts()["holder"] == "other"
    assert bench.call("endRecording")["status"] == "success"
    assert bench.state.words.said() is Said.END


@pytest.mark.parametrize("stopped", [True, False])
@pytest.mark.parametrize("on_mesh", [True, False])
def test_recorder_leaves_its_network_once_the_stop_that_ended_it_is_answered(
    monkeypatch: pytest.MonkeyPatch, stopped: bool, on_mesh: bool
) -> None:
    order: list[object] = []

    @contextmanager
    def on_network(*_given: object) -> Iterator[None]:
        yield
        order.append("left")

    monkeypatch.setattr(recorder_device, "device_of", on_network)
    monkeypatch.setattr(recorder_device, "peer_of", on_network)
    monkeypatch.setattr(recorder_device.time, "sleep", order.append)
    state = RecordingState()
    with recorder_served(Screen(), Network(), "arm-1", state, "wave", on_mesh=on_mesh, needed=True):
        if stopped:
            state.halt("the recording was stopped")
    assert order == ([2.5 if on_mesh else 1.0] if stopped else []) + ["left"]
