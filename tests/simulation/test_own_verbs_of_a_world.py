"""A simulated world with a verb of its own, which moves its arm by the built-in motions."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Any

import pytest
from fixtures.waiting import eventually

from strands_robots import Permit, Simulation, verb
from strands_robots.safety.stop_executor import stop_executor
from strands_robots.serving.control_leases import leases_of
from strands_robots.serving.offered_verbs import own_verbs
from strands_robots.serving.pipeline import Command, Pipeline, Result
from strands_robots.serving.robot_verbs import WORLD_VERBS
from strands_robots.serving.stops import WorldStop, robot_stop, stop_within


class Nodding(Simulation):
    """A world that nods until it is stopped."""

    nods = 0

    @verb(motion=True, lasts=60.0)
    def nod_along(self, permit: Permit) -> dict[str, Any]:
        """Nod."""
        while permit.valid:
            for degrees in (10.0, -10.0):
                self.move_joints({"wrist_flex": degrees}, speed=1.0)
            self.nods += 1
        return {"nods": self.nods}


@pytest.fixture
def world(patient_halts: None) -> Iterator[Nodding]:
    nodding = Nodding(tool_name="world", realtime=False)
    nodding.add_robot("left", model="so100")
    yield nodding
    nodding.cleanup()


def serve(world: Nodding, name: str, **arguments: Any) -> Result:
    pipeline = Pipeline.of(world, lambda: "sim-1", hardware=False, authorize=lambda command, given: ("tester",))
    answers: list[Result] = []
    verbs = {**WORLD_VERBS, **own_verbs(world)}
    pipeline.serve(Command(verbs[name], arguments, "tester", pipeline.pending.arrive()), answers.append)
    return answers[0]


@pytest.mark.parametrize("whole", [True, False], ids=["world", "one robot of it"])
def test_verb_that_moves_by_built_in_motions_ends_with_a_stop(world: Nodding, whole: bool) -> None:
    for _ in range(2):
        before, answers = world.nods, list[Result]()
        working = threading.Thread(target=lambda to=answers: to.append(serve(world, "nodAlong")))
        working.start()
        eventually(lambda count=before: world.nods > count)
        assert "nodAlong of this robot has not returned" in serve(world, "execute", instruction="wave").result["reason"]
        target = WorldStop(world) if whole else robot_stop(world, "left")
        verdict = stop_executor().halt(target, "left", "stop", within=stop_within(target))
        assert verdict.stopped is True
        assert "nodAlong" in verdict.halted
        working.join(20.0)
        assert answers[0].result["task_status"] == "stopped"
        assert not world.gate.under_way
    assert serve(world, "moveJoints", joints={"wrist_flex": 0.0}, speed=1.0).result["status"] == "success"


def test_verb_of_the_world_is_refused_while_one_of_its_robots_is_held(world: Nodding) -> None:
    world.add_robot("right", model="so100")
    held = leases_of(world, hardware=False).of("right").acquire("other", "agent", 60.0)
    assert held["lease_id"]
    answer = serve(world, "nodAlong").result
    assert (answer["status"], answer["refused"], answer["holder"]) == ("error", "control", "other")
    assert world.nods == 0
