"""Simulated robots for other people's tests: what calls them meets a real network, and their faults."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import device_connect_agent_tools as agent_tools
import pytest
from fixtures.waiting import eventually

from strands_robots import connect
from strands_robots.errors import NoAnswerError, NoSuchRobotError, RefusalError
from strands_robots.fleet import Fleet
from strands_robots.safety.plane import plane
from strands_robots.testing import LabCall, RobotLab
from strands_robots.tools import robot_mesh
from strands_robots.utils import ValidationError


@pytest.fixture
def lab() -> Iterator[RobotLab]:
    """Three robots that sway."""
    with RobotLab(3) as lab:
        yield lab


@pytest.fixture
def lab_for_desk() -> Iterator[RobotLab]:
    """A robot that one caller may move."""
    with RobotLab(1, {"DEVICE_CONNECT_RPC_ALLOW": "desk"}) as lab:
        yield lab


@pytest.fixture
def fleet(lab: RobotLab) -> Iterator[Fleet]:
    """A caller that knows them, and had them move."""
    with connect(name="tester") as fleet:
        for each in lab.ids:
            fleet[each].call("execute", instruction="wave", duration=300)
        assert lab.moving == lab.ids
        yield fleet


def test_fifty_robots_are_served_found_and_gone_and_the_users_settings_are_back(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("STRANDS_STATE_DIR", str(tmp_path))
    monkeypatch.setenv("ZENOH_CONNECT", "tcp/127.0.0.1:1")
    with RobotLab(50) as lab:
        assert len(lab) == 50
        with connect() as fleet:
            eventually(lambda: {each.id for each in fleet.robots()} == set(lab.ids))
    assert (os.environ["STRANDS_STATE_DIR"], os.environ["ZENOH_CONNECT"]) == (str(tmp_path), "tcp/127.0.0.1:1")
    assert not list(tmp_path.iterdir())
    assert not [each for each in plane().robots if each.startswith("robot-")]
    assert "robot-lab" not in {each.name for each in threading.enumerate()}


def test_robot_records_the_calls_that_reached_it_and_does_what_they_say(lab: RobotLab) -> None:
    with connect(name="tester") as fleet:
        assert fleet["robot-2"].call("turn", joint="pan", degrees=3)["degrees"] == 3.0
    assert lab["robot-2"].joints["pan"] == pytest.approx(3.0)
    assert lab["robot-2"].calls == [LabCall("turn", {"joint": "pan", "degrees": 3}, "tester")]
    assert lab["robot-1"].calls == []


def test_silent_robot_is_found_and_answers_nothing_and_moves_on(lab: RobotLab, fleet: Fleet) -> None:
    lab["robot-1"].silence()
    assert "robot-1" in {each.id for each in fleet.robots()}
    with pytest.raises(NoAnswerError):
        fleet["robot-1"].call("getState", timeout=0.3)
    assert lab["robot-1"].calls[-1].verb == "getState"
    lab["robot-1"].restore()
    assert fleet["robot-1"].halt().stopped is True
    assert lab.moving == ["robot-2", "robot-3"]


def test_liar_says_that_it_stopped_and_its_status_gives_it_away(lab: RobotLab, fleet: Fleet) -> None:
    lab["robot-1"].lie()
    verdict = fleet["robot-1"].halt()
    assert verdict.stopped is False
    assert "says running after the stop" in str(verdict)
    before = lab["robot-1"].joints
    eventually(lambda: lab["robot-1"].joints != before)


def test_late_robot_does_at_once_what_it_answers_later(lab: RobotLab, fleet: Fleet) -> None:
    lab["robot-1"].delay(0.4)
    with pytest.raises(NoAnswerError):
        fleet["robot-1"].call("getState", timeout=0.1)
    assert fleet["robot-1"].call("getState", timeout=10)["joints"]
    verdict = fleet["robot-1"].halt()
    assert verdict.stopped is True
    assert verdict.elapsed_ms >= 400


def test_robot_whose_network_is_cut_is_missed_by_an_emergency_stop_and_locked_when_it_is_back(
    lab: RobotLab, fleet: Fleet
) -> None:
    lab["robot-1"].cut()
    verdict = fleet.estop("smoke")
    assert {name for name, each in verdict.items() if each.stopped is not True} == {"robot-1"}
    assert verdict["robot-1"].unknown
    assert lab.moving == ["robot-1"]
    with connect() as other:
        eventually(lambda: {each.id for each in other.robots()} == {"robot-2", "robot-3"})
        with pytest.raises(NoSuchRobotError):
            other["robot-1"]
    lab.restore()
    assert [each.locked for each in lab] == [True] * 3
    lab.resume()
    assert fleet["robot-1"].halt().stopped is True
    assert not lab["robot-1"].locked


def test_network_of_all_robots_is_cut_and_restored(lab: RobotLab, fleet: Fleet) -> None:
    lab.cut()
    for each in lab.ids:
        with pytest.raises(RefusalError):
            fleet[each].call("getState", timeout=0.3)
    assert lab.moving == lab.ids
    lab.restore()
    # The caller's link comes back by itself.
    for each in lab.ids:
        assert eventually(lambda robot=fleet[each]: robot.halt().stopped)


def test_tools_of_agents_reach_them_and_are_disconnected_with_them(monkeypatch: pytest.MonkeyPatch) -> None:
    disconnect, disconnected = agent_tools.disconnect, threading.Event()
    monkeypatch.setattr(agent_tools, "disconnect", lambda: (disconnect(), disconnected.set()))
    with RobotLab(2) as lab:
        assert robot_mesh(action="tell", target="robot-1", instruction="wave", duration=300)["status"] == "success"
        assert len(agent_tools.discover("device(*)")["results"]) == 2
        assert lab.moving == ["robot-1"]
        stopped = agent_tools.invoke("device(robot-1).function(stop)")["result"]
        assert stopped["stopped"] is True
        assert lab.moving == []
        assert not disconnected.is_set()
    assert disconnected.is_set()


def test_lab_takes_settings_and_refuses_a_caller_by_them(lab_for_desk: RobotLab) -> None:
    with connect(name="somebody") as fleet, pytest.raises(RefusalError, match="DEVICE_CONNECT_RPC_ALLOW"):
        fleet["robot-1"].call("execute", instruction="wave")
    with connect(name="desk") as fleet:
        assert fleet["robot-1"].call("execute", instruction="wave")["status"] == "success"


@pytest.mark.parametrize(
    ("more", "named"),
    [({"NO_SUCH_SETTING": "1"}, "more must have"), ({"TENANT": 1}, r"more\['TENANT'\]"), (["TENANT"], "more must be")],
)
def test_wrong_setting_is_refused_by_name(more: Any, named: str) -> None:
    with pytest.raises(ValidationError, match=rf"^{named}"):
        RobotLab(1, more)


@pytest.mark.parametrize("count", [0, -1, 201, True, 2.0, "3", float("nan")])
def test_wrong_number_of_robots_is_refused_by_name(count: Any) -> None:
    with pytest.raises(ValidationError, match=r"^count must be"):
        RobotLab(count)


@pytest.mark.parametrize("seconds", [0, -1, 61, True, float("nan"), "1"])
def test_wrong_delay_is_refused_by_name(seconds: Any) -> None:
    with pytest.raises(ValidationError, match=r"^seconds must be"):
        RobotLab(1)["robot-1"].delay(seconds)


def test_unknown_robot_is_refused_with_the_names_that_there_are() -> None:
    with pytest.raises(ValidationError, match=r"did you mean robot-1|robot-1"):
        RobotLab(1)["robot-7"]


def test_second_lab_is_refused_and_the_first_one_goes_on(lab: RobotLab) -> None:
    with pytest.raises(RuntimeError, match="one lab at a time"), RobotLab(1):
        pytest.fail("two labs share one environment")
    with connect() as fleet:
        assert fleet["robot-1"].call("getState")["status"] == "success"


def test_lab_that_is_not_entered_says_how() -> None:
    with pytest.raises(RuntimeError, match="with RobotLab"):
        RobotLab(1)["robot-1"].cut()
