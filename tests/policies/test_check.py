"""A policy that does not fit its robot moves nothing: each mismatch is refused, or unverified."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pytest
from fixtures.checkpoints import statistics, write_checkpoint, write_dataset, write_safetensors

from strands_robots.policies.base import numbers
from strands_robots.policies.check import PolicyCheck, RobotFacts, check_policy, statements_of
from strands_robots.policies.profiles import load_profiles

KEYS = ["pan.pos", "lift.pos", "grip.pos"]
NAMES = ["pan", "lift", "grip"]


@dataclass
class Scene:
    """A policy that fits its robot; a test changes one thing."""

    folder: Path
    checkpoint: dict[str, Any] = field(default_factory=dict)
    dataset: dict[str, Any] = field(default_factory=lambda: {"names": NAMES})
    entries: dict[str, Any] = field(default_factory=dict)
    robot: RobotFacts = field(
        default_factory=lambda: RobotFacts(
            "arm",
            {"pan.pos": 1.0, "lift.pos": 2.0, "grip.pos": 3.0, "battery": 80.0},
            KEYS,
            {"pan.pos": "degrees", "lift.pos": "degrees", "grip.pos": "percent"},
            {"front": (480, 640, 3), "wrist": (480, 640, 3)},
            50.0,
        )
    )
    damage: Callable[[Path], object] = lambda checkpoint: None

    def __post_init__(self) -> None:
        self.entries = {
            "provider": "lerobot_local",
            "checkpoint": str(self.folder / "checkpoint"),
            "dataset": str(self.folder / "dataset"),
            "state": KEYS,
            "action": KEYS,
            "units": {"default": "degrees", "grip.pos": "percent"},
            "rate": 30.0,
            "chunk": 20,
            "horizon": 10,
            "cameras": {"front": {"key": "observation.images.front", "size": [96, 128]}},
        }

    def camera(self, **entries: Any) -> None:
        self.entries["cameras"]["front"] |= entries

    def check(self) -> PolicyCheck:
        write_dataset(self.folder / "dataset", **self.dataset)
        self.damage(write_checkpoint(self.folder / "checkpoint", **self.checkpoint))
        file = self.folder / "policies.toml"
        file.write_text(toml("pick", self.entries))
        profile = load_profiles(file)["pick"]
        return check_policy(profile, statements_of(profile), self.robot)


def toml(name: str, entries: dict[str, Any]) -> str:
    """Entries as a table; JSON's scalars and lists are TOML's."""
    plain = [f"{json.dumps(key)} = {json.dumps(each)}" for key, each in entries.items() if not isinstance(each, dict)]
    tables = [toml(f"{name}.{json.dumps(key)}", each) for key, each in entries.items() if isinstance(each, dict)]
    return "\n".join([f"[{name}]", *plain, *tables])


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    return Scene(tmp_path)


def test_a_policy_that_fits_passes_with_both_sides_of_every_row(scene: Scene) -> None:
    found = scene.check()
    assert found.passed, found.refusal()
    assert found.refusal() == ""
    questions = {row.question for row in found.rows}
    assert {"state order", "state size", "state in the data", "action order", "action size"} <= questions
    assert {
        "picture observation.images.front",
        "statistics of action",
        "unit of grip.pos",
        "rate",
        "chunk",
    } <= questions


def robot(**changed: Any) -> Callable[[Scene], None]:
    def change(scene: Scene) -> None:
        scene.robot = replace(scene.robot, **changed)

    return change


def entry(**changed: Any) -> Callable[[Scene], None]:
    return lambda scene: scene.entries.update(changed)


def without(*names: str) -> Callable[[Scene], None]:
    def change(scene: Scene) -> None:
        for name in names:
            del scene.entries[name]

    return change


def both(*changes: Callable[[Scene], None]) -> Callable[[Scene], None]:
    def change(scene: Scene) -> None:
        for each in changes:
            each(scene)

    return change


def made(**changed: Any) -> Callable[[Scene], None]:
    return lambda scene: scene.checkpoint.update(changed)


def data(**changed: Any) -> Callable[[Scene], None]:
    return lambda scene: scene.dataset.update(changed)


def damaged(damage: Callable[[Path], object]) -> Callable[[Scene], None]:
    return lambda scene: setattr(scene, "damage", damage)


def remove(name: str) -> Callable[[Scene], None]:
    return damaged(lambda folder: (folder / name).unlink())


def cut(folder: Path) -> None:
    weights = folder / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:-4])


def empty(folder: Path) -> None:
    write_safetensors(folder / "model.safetensors", {})


def scrambled(folder: Path) -> None:
    (folder / "model.safetensors").write_bytes(b"\xff" * 64)


FRONT = {"front": {"key": "observation.images.front", "size": [96, 128]}}
TWO = {"observation.images.front": (3, 96, 128), "observation.images.wrist": (3, 96, 128)}
SWAPPED = ["lift.pos", "pan.pos", "grip.pos"]

REFUSED: dict[str, tuple[Callable[[Scene], None], str]] = {
    "a camera of the policy is not mapped": (made(images=TWO), "picture observation.images.wrist"),
    "no camera is mapped at all": (without("cameras"), "picture observation.images.front"),
    "a camera has a key that the policy does not know": (
        entry(cameras=FRONT | {"wrist": {"key": "observation.images.top", "size": [96, 128]}}),
        "picture observation.images.top",
    ),
    "a short key, which matches nothing": (
        entry(cameras={"front": {"key": "front", "size": [96, 128]}}),
        "picture observation.images.front",
    ),
    "the robot has no such camera": (robot(cameras={"top": (480, 640, 3)}), "camera front"),
    "pictures have another size": (lambda scene: scene.camera(size=[128, 96]), "picture observation.images.front"),
    "pictures are not resized": (entry(cameras={"front": {"key": "observation.images.front"}}), "picture observation"),
    "the policy wants grey pictures": (
        made(images={"observation.images.front": (1, 96, 128)}),
        "picture observation.images.front",
    ),
    "the camera gives RGBA": (robot(cameras={"front": (480, 640, 4)}), "camera front"),
    "the camera gives pictures channel-first": (robot(cameras={"front": (3, 480, 640)}), "camera front"),
    "the crop is outside of the picture": (lambda scene: scene.camera(crop=[600, 0, 100, 100]), "camera front"),
    "the state is too short": (made(state=4), "state size"),
    "the state is too long": (made(state=2), "state size"),
    "a state of one number, which would be broadcast": (made(state=1), "state size"),
    "the state has another order than the data": (entry(state=SWAPPED), "state order"),
    "the state has a name that the robot has not": (entry(state=["tilt.pos", *KEYS[1:]]), "state names"),
    "a joint gives no number": (
        robot(state=numbers({"pan.pos": math.nan, "lift.pos": 2.0, "grip.pos": 3.0})),
        "state names",
    ),
    "a joint gives NaN": (robot(state={"pan.pos": math.nan, "lift.pos": 2.0, "grip.pos": 3.0}), "state values"),
    "the state is far outside of the data": (
        robot(state={"pan.pos": 1e6, "lift.pos": 2.0, "grip.pos": 3.0}),
        "state in the data",
    ),
    "the action is too short": (made(action=4), "action size"),
    "the action is too long": (made(action=2), "action size"),
    "the action has another order than the data": (entry(action=SWAPPED), "action order"),
    "the action has a name that the robot has not": (entry(action=["tilt.pos", *KEYS[1:]]), "action names"),
    "a joint of the robot is not commanded": (entry(action=KEYS[:2]), "action names"),
    "the data is of another robot": (data(names=["waist", "shoulder", "grip"]), "action order"),
    "units differ and cannot be converted": (robot(units=dict.fromkeys(KEYS, "normalized")), "unit of pan.pos"),
    "the gripper has another unit": (entry(units="degrees"), "unit of grip.pos"),
    "the data was recorded at another rate": (data(fps=50), "rate of the data"),
    "the robot is slower than the data": (robot(rate=20.0), "rate"),
    "the policy predicts another chunk": (made(chunk=50), "chunk"),
    "more is played than the policy predicts": (
        both(without("chunk"), entry(horizon=21)),
        "horizon",
    ),
    "statistics of the action are absent": (made(after={"observation.state": statistics()}), "statistics of action"),
    "statistics of the state are absent": (made(before={"action": statistics()}), "statistics of observation.state"),
    "the processors are absent": (remove("policy_preprocessor.json"), "statistics of action"),
    "the weights are absent": (remove("model.safetensors"), "checkpoint"),
    "the weights are cut off": (damaged(cut), "checkpoint"),
    "the weights are no weights": (damaged(scrambled), "checkpoint"),
    "the weights are empty": (
        damaged(lambda folder: write_safetensors(folder / "model.safetensors", {})),
        "checkpoint",
    ),
    "the configuration is absent": (remove("config.json"), "checkpoint"),
    "the checkpoint is not there": (entry(checkpoint="/nowhere/at/all"), "checkpoint"),
    "the dataset is not there": (entry(dataset="/nowhere/at/all"), "checkpoint"),
}


def test_another_type_than_that_of_the_checkpoint_is_refused(scene: Scene) -> None:
    scene.entries |= {"provider": "lerobot_async", "url": "grpc://localhost", "policy_type": "act"}
    assert scene.check().passed
    scene.entries["policy_type"] = "smolvla"
    (row,) = scene.check().failures
    assert (row.question, row.outcome, row.change) == ("policy type", "refused", 'set policy_type = "act"')


def test_a_checkpoint_that_only_its_server_has_states_nothing(scene: Scene) -> None:
    scene.entries |= {"provider": "lerobot_async", "url": "grpc://localhost", "policy_type": "act"}
    scene.entries |= {"checkpoint": "somebody/act_pick_cube"}
    found = scene.check()
    assert {row.question for row in found.rows} & {"state order", "picture observation.images.front"} == {"state order"}


@pytest.mark.parametrize(("change", "question"), REFUSED.values(), ids=REFUSED)
def test_a_mismatch_is_refused_and_names_both_sides(
    scene: Scene, change: Callable[[Scene], None], question: str
) -> None:
    change(scene)
    found = scene.check()
    assert not found.passed
    row = next(each for each in found.failures if each.question.startswith(question))
    assert row.outcome == "refused"
    assert row.policy
    assert row.robot
    assert row.change
    assert row.change in found.refusal()


UNVERIFIED: dict[str, tuple[Callable[[Scene], None], str, str]] = {
    "no source states units": (without("units"), "unit of pan.pos", "units"),
    "the robot states no units": (robot(units={}), "unit of pan.pos", "units"),
    "the profile states no rate": (without("rate"), "rate", "rate"),
    "a server resizes pictures as it likes": (
        both(
            without("checkpoint", "dataset"),
            entry(url="ws://localhost:8000", cameras={"front": {"key": "observation/image"}}),
        ),
        "camera front, image size",
        "image size",
    ),
}


@pytest.mark.parametrize(("change", "question", "name"), UNVERIFIED.values(), ids=UNVERIFIED)
def test_what_nothing_states_is_unverified_until_it_is_confirmed(
    scene: Scene, change: Callable[[Scene], None], question: str, name: str
) -> None:
    change(scene)
    found = scene.check()
    assert {row.outcome for row in found.failures} == {"unverified"}
    assert any(row.question == question and name in row.change for row in found.failures)
    scene.entries["confirmed"] = [name]
    confirmed = scene.check()
    assert confirmed.passed, confirmed.refusal()
    assert any(row.outcome == "confirmed" for row in confirmed.rows)


def test_what_is_contradicted_cannot_be_confirmed(scene: Scene) -> None:
    scene.robot = replace(scene.robot, units=dict.fromkeys(KEYS, "normalized"))
    scene.dataset["fps"] = 50
    scene.entries["confirmed"] = ["units", "rate", "image size"]
    assert {row.outcome for row in scene.check().failures} == {"refused"}


def test_radians_and_degrees_are_converted_and_no_mismatch(scene: Scene) -> None:
    scene.robot = replace(
        scene.robot,
        state={"pan.pos": 0.1, "lift.pos": 0.2, "grip.pos": 3.0},
        units={"pan.pos": "radians", "lift.pos": "radians", "grip.pos": "percent"},
    )
    assert scene.check().passed


def test_older_names_of_the_same_joints_are_the_same(scene: Scene) -> None:
    scene.dataset["names"] = ["main_pan", "main_lift", "main_grip"]
    assert scene.check().passed
