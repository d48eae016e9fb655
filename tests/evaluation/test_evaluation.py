"""Episodes in simulation: experts succeed, ``mock`` does not, and everything is recorded."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy
import pytest

from strands_robots import policies
from strands_robots.evaluation import ROBOT, TASKS, run_episode, table_of, task_of, write_plot
from strands_robots.policies.check import PolicyCheckError
from strands_robots.recording.file import STEP, RecordedEvent, RecordedJoints, read_items
from strands_robots.simulation import Simulation
from strands_robots.utils import ValidationError

JOINTS = ["shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper"]
TARGET = ["target.x", "target.y", "target.z"]


@pytest.mark.parametrize("task", TASKS)
def test_the_expert_of_a_task_reaches_its_goal(task: str) -> None:
    episode = run_episode(f"expert:{task}", task, 1)
    assert episode.success, episode.error
    assert 0 < episode.seconds < TASKS[task].seconds
    assert episode.error == ""


def test_mock_does_not_reach_the_goal_and_takes_the_whole_time() -> None:
    episode = run_episode("mock", "reach", 1)
    assert not episode.success
    assert episode.seconds == pytest.approx(TASKS["reach"].seconds, abs=0.05)


def test_a_seed_is_an_episode_that_can_be_repeated() -> None:
    one, again, other = (run_episode("expert:reach", "reach", seed) for seed in (3, 3, 4))
    assert one == again
    assert one.steps != other.steps


def test_no_task_is_achieved_where_it_begins() -> None:
    for name in TASKS:
        world = Simulation(realtime=False)
        world.add_robot(ROBOT, "so100")
        for seed in range(5):
            task = task_of(name)
            task.set_up(world, numpy.random.default_rng(seed))
            assert not task.achieved(world), f"{name}, seed {seed}"
            for each in world.objects(ROBOT):
                world.remove_object(each.name)
        world.cleanup()
    with pytest.raises(ValidationError, match="task must be one of reach, push_cube, pick_place"):
        task_of("sing")


def test_an_expert_plays_its_own_task_alone() -> None:
    with pytest.raises(ValidationError, match="must be expert:reach for the task reach"):
        run_episode("expert:push_cube", "reach", 1)
    with pytest.raises(ValidationError, match="policy_provider must be one of"):
        run_episode("nothing", "reach", 1)


def test_an_episode_is_recorded_with_its_steps_and_its_outcome_in_simulated_time(tmp_path: Path) -> None:
    file = tmp_path / "one.mcap"
    episode = run_episode("expert:reach", "reach", 1, recording=file)
    items = list(read_items(file))
    steps = [item for item in items if isinstance(item, RecordedEvent) and item.event == STEP]
    assert len(steps) == episode.steps
    assert set(steps[0].payload["observation"]) == {*JOINTS, *TARGET}
    assert steps[-1].at - steps[0].at == pytest.approx((episode.steps - 1) / 50, abs=0.5)
    assert any(isinstance(item, RecordedJoints) for item in items)
    ended = next(item for item in items if isinstance(item, RecordedEvent) and item.event == "policyComplete")
    assert ended.payload["steps"] == episode.steps
    assert "missed_ticks" in ended.payload["loop"]


class TowardsTarget:
    """Turns the arm towards the target; notes what it sees."""

    uses_cameras = False

    def __init__(self) -> None:
        self.seen: list[Mapping[str, Any]] = []

    def reset(self, instruction: str, ranges: Any) -> None: ...

    def act(self, observation: Mapping[str, Any]) -> Any:
        self.seen.append(observation)
        return [{**{key: observation[key] for key in JOINTS}, "shoulder_pan": 0.1}] * 20

    def interrupt(self) -> None: ...

    def close(self) -> None: ...


@pytest.fixture
def profile(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[TowardsTarget]:
    """A profile whose policy is :class:`TowardsTarget`; those that were made."""
    file = tmp_path / "policies.toml"
    file.write_text(
        f'[towards]\nprovider = "remote"\nurl = "ws://localhost:9"\nstate = {json.dumps(JOINTS)}\n'
        f'environment = {json.dumps(TARGET)}\naction = {json.dumps(JOINTS)}\nunits = "radians"\nrate = 25\n'
    )
    monkeypatch.setenv("STRANDS_POLICIES", str(file))
    made: list[TowardsTarget] = []

    def make() -> TowardsTarget:
        made.append(TowardsTarget())
        return made[-1]

    monkeypatch.setattr(policies, "policy_factory", lambda name: make)
    return made


def test_a_profile_is_evaluated_through_its_check_and_its_loop(profile: list[TowardsTarget]) -> None:
    episode = run_episode("towards", "reach", 1, latency_s=0.2)
    assert list(profile[0].seen[0]) == [*JOINTS, *TARGET]
    assert episode.loop["latency_max_ms"] == pytest.approx(200)
    assert episode.loop["inferences"] > 3
    assert episode.loop["stale_actions"] > 0


@pytest.mark.usefixtures("profile")
def test_a_profile_that_does_not_fit_the_task_is_refused() -> None:
    with pytest.raises(PolicyCheckError, match="environment has target"):
        run_episode("towards", "push_cube", 1)


def test_the_report_has_a_row_and_a_mark_for_each_policy(tmp_path: Path) -> None:
    outcomes = {name: [run_episode(name, "reach", seed) for seed in range(2)] for name in ("expert:reach", "mock")}
    table = table_of(outcomes)
    assert "| expert:reach | 2 | 100 % | 34 to 100 % |" in table
    assert "| mock | 2 | 0 % | 0 to 66 % | - |" in table
    write_plot(tmp_path / "plot.svg", "reach <1>", outcomes)
    drawn = (tmp_path / "plot.svg").read_text()
    assert drawn.count("<circle") == 2
    assert "reach &lt;1&gt;" in drawn
