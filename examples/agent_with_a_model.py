"""Have a language model put the red cube on the plate, with the one tool ``robot_mesh``.

Serve an arm at its table in another terminal first::

    strands-robots serve so100 --set scene=tabletop

Any Strands model does: name its class in ``strands.models`` and what it is made with. Package and key are yours::

    python examples/agent_with_a_model.py BedrockModel model_id=MODEL
    python examples/agent_with_a_model.py AnthropicModel model_id=MODEL max_tokens=4000
    python examples/agent_with_a_model.py OllamaModel host=http://localhost:11434 model_id=MODEL

Exits with 0 only if the simulation says that the cube stands on the plate, whatever the model says.
"""

from __future__ import annotations

import json
import math
import sys
from typing import Any

import strands.models
from strands import Agent

from strands_robots.envelope import Envelope, text_of
from strands_robots.tools import robot_mesh

TASK = """
The arm {arm} has a red cube and a plate on its table. Look at a picture of the table and read the objects (getObjects).
Pick the red cube up and put it on the plate. Read the objects again to see whether it stands there, and report.
If the arm refuses, say why and end: do not free a locked robot.
"""


def main() -> int:
    try:
        model = model_of(sys.argv[1:])
    except (ValueError, TypeError, ImportError) as exc:
        print(f"No model: {exc}", file=sys.stderr)
        print("Name one, such as: agent_with_a_model.py BedrockModel model_id=MODEL", file=sys.stderr)
        return 2
    return put_cube_on_plate(model)


def model_of(arguments: list[str]) -> strands.models.Model:
    """Make the model that the command line names.

    Raises:
        ValueError: none is named, or its arguments are not key=value.
        TypeError: ``strands.models`` has no such class, or it takes other arguments.
        ImportError: the package of its provider is not installed.
    """
    if not arguments:
        raise ValueError("none is configured.")
    name, *pairs = arguments
    made = getattr(strands.models, name, None)
    if not (isinstance(made, type) and issubclass(made, strands.models.Model)):
        raise TypeError(f"{name} is no model of strands.models.")
    options: dict[str, Any] = {}
    for pair in pairs:
        key, equals, value = pair.partition("=")
        if not equals:
            raise ValueError(f"arguments of {name} must be key=value, not {pair}.")
        try:
            options[key] = json.loads(value)
        except ValueError:
            options[key] = value
    return made(**options)


def put_cube_on_plate(model: strands.models.Model) -> int:
    """Give the task to an agent, and ask the robot, not the model, what came of it."""
    peers = robot_mesh(action="peers").get("peers", [])
    arms = [each["id"] for each in peers if "pick" in each.get("functions", ())]
    if not arms:
        print("No arm answers. Start one: strands-robots serve so100 --set scene=tabletop", file=sys.stderr)
        return 1
    agent = Agent(model=model, tools=[robot_mesh])
    try:
        agent(TASK.format(arm=arms[0]))
    except Exception as exc:  # noqa: BLE001 - each provider raises its own, and the arm must not move on
        robot_mesh(action="stop", target=arms[0])
        print(f"The model failed, and the arm was stopped: {type(exc).__name__}: {exc}", file=sys.stderr)
        return 1
    answer: Envelope = robot_mesh(action="call", target=arms[0], verb="getObjects")
    objects = answer.get("objects", {})
    if not {"red_cube", "plate"} <= objects.keys():
        print(f"No cube and plate to be seen: {text_of(answer)}", file=sys.stderr)
        return 1
    done = stands_on(objects["red_cube"], objects["plate"])
    print("\nThe cube stands on the plate." if done else "\nThe cube is not on the plate.")
    return 0 if done else 1


def stands_on(cube: dict[str, Any], plate: dict[str, Any]) -> bool:
    """Return whether the cube's centre is over the plate and its bottom at the plate's top."""
    away = math.hypot(cube["x"] - plate["x"], cube["y"] - plate["y"])
    above = (cube["z"] - cube["size"][2] / 2) - (plate["z"] + plate["size"][2] / 2)
    return bool(away <= plate["size"][0] / 2 and abs(above) <= 0.005)


if __name__ == "__main__":
    sys.exit(main())
