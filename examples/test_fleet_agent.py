"""CI of an agent against fifty robots: it finds them, moves them, and stops them when some of them do not behave.

Nothing here needs a robot, a network, a key or a model::

    pip install pytest 'strands-robots-edge[device-connect,agent]'
    pytest examples/test_fleet_agent.py

``robots`` is a fixture of strands_robots. ``ScriptedModel`` is a language model that does what it is told, so that the
test is of the agent and its tools; give your own model in its place.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from strands import Agent

from strands_robots.testing import RobotLab, ScriptedModel
from strands_robots.tools import robot_mesh

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of packages that these import

WAVE = {"instruction": "wave", "duration": 300}


def answers(*calls: dict[str, Any]) -> list[dict[str, Any]]:
    """Return what the tool answered an agent that makes these calls, one a turn."""
    model = ScriptedModel([*(("robot_mesh", each) for each in calls), "That is all."])
    agent = Agent(model=model, tools=[robot_mesh], callback_handler=None)
    agent("Have every robot wave, and stop them all.")
    return [block["toolResult"] for message in agent.messages for block in message["content"] if "toolResult" in block]


def test_agent_finds_moves_and_stops_fifty_robots(robots: Callable[..., RobotLab]) -> None:
    lab = robots(50)
    # A busy machine may answer late, so the agent looks more than once.
    found = [str(each["content"]) for each in answers(*3 * [{"action": "peers"}])]
    assert any(all(f"'id': '{each}'" in listed for each in lab.ids) for listed in found)

    started = answers(*({"action": "tell", "target": each, **WAVE} for each in lab.ids))
    assert {each["status"] for each in started} == {"success"}
    assert lab.moving == lab.ids

    (stopped,) = answers({"action": "stop"})
    assert stopped["status"] == "success"
    assert lab.moving == []


def test_agent_is_told_which_robots_an_emergency_stop_did_not_stop(robots: Callable[..., RobotLab]) -> None:
    lab = robots(50)
    answers(*({"action": "tell", "target": each, **WAVE} for each in lab.ids))
    lab["robot-7"].silence()
    lab["robot-8"].lie()
    lab["robot-9"].delay(1.0)
    lab["robot-10"].cut()

    (stopped,) = answers({"action": "emergency_stop", "instruction": "smoke"})

    assert stopped["status"] == "error"
    said = str(stopped["content"])
    assert "robot-8 did not stop" in said
    assert all(f"{each} gave no answer" in said for each in ("robot-7", "robot-10"))
    assert "robot-9 " not in said  # late, and stopped
    assert lab.moving == ["robot-7", "robot-8", "robot-10"]

    lab.restore()
    assert all(each.locked for each in lab)  # a robot that missed the stop learns of it when it is back
