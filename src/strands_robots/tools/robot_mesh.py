"""``robot_mesh``: one agent tool that finds robots, drives them and stops them.

::

    from strands import Agent
    from strands_robots.tools import robot_mesh

    Agent(tools=[robot_mesh])("Which robots are there? Let the arm wave.")
"""

from __future__ import annotations

from typing import Any

from strands_robots.agent_tool import tool
from strands_robots.envelope import error
from strands_robots.serving.robot_verbs import ARM_VERBS
from strands_robots.tools import networks
from strands_robots.utils import ValidationError, choice, device_id, text

ACTIONS = ("peers", "tell", "status", "stop", "emergency_stop", "release_torque")
NEEDS_TARGET = ("tell", "status", "release_torque")


@tool
def robot_mesh(
    action: str,
    target: str = "",
    instruction: str = "",
    policy_provider: str = "mock",
    duration: float = 30.0,
) -> dict[str, Any]:
    """Find robots, give them instructions, ask for their status, and stop them.

    A robot that does not answer, or does not confirm that it stopped, is an error: never assume that it stands still.

    Args:
        action: peers lists the robots; tell gives one an instruction and returns once the motion has started; status
            returns what one is doing; stop stops one, or all without a target; emergency_stop stops and locks all;
            release_torque stops one and switches its motors off, so that it falls, once its operator approved that.
        target: The robot's id, as peers lists it. Needed by tell, status and release_torque.
        instruction: What to do, in plain language, 1 to 2000 characters. For emergency_stop: the reason.
        policy_provider: Policy that decides the actions, such as remote or lerobot_local; mock moves by itself and
            follows no instruction.
        duration: Longest time the motion may take, in seconds, above 0 and at most 3600.
    """
    try:
        verb = choice("action", action, ACTIONS)
        robot = device_id("target", target) if target or verb in NEEDS_TARGET else ""
        if verb == "tell":
            given = {"instruction": instruction, "policy_provider": policy_provider, "duration": duration}
            task = ARM_VERBS["execute"].checked(given)
            return networks.network().tell(robot, task["instruction"], task["policy_provider"], task["duration"])
        if verb == "emergency_stop":
            return networks.network().emergency_stop(text("instruction", instruction, empty=True))
    except ValidationError as refused:
        return error(str(refused))
    if verb == "stop":
        return networks.network().stop(robot)
    if verb == "release_torque":
        return networks.network().release_torque(robot)
    return networks.network().status(robot) if verb == "status" else networks.network().peers()
