"""Every source of a policy against every other: 60 mismatches, on datasets of both versions, and none in silence."""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from fixtures.checkpoints import MODES, Vectors, statistics, write_checkpoint, write_dataset, write_safetensors

from strands_robots.policies.check import PolicyCheck, PolicyCheckError, RobotFacts, check_policy, statements_of
from strands_robots.policies.profiled import ProfiledPolicy
from strands_robots.policies.profiles import CameraMap, Profile

KEYS = ("pan.pos", "lift.pos", "grip.pos")
LOW, HIGH = (-90.0, -80.0, 0.0), (90.0, 80.0, 100.0)
STATE, ACTION, FRONT = "observation.state", "action", "observation.images.front"
ROBOT = RobotFacts(
    "arm",
    {"pan.pos": 1.0, "lift.pos": 2.0, "grip.pos": 30.0},
    KEYS,
    {"pan.pos": "degrees", "lift.pos": "degrees", "grip.pos": "percent"},
    {"front": (480, 640, 3)},
    50.0,
    {"pan.pos": (-110.0, 110.0), "lift.pos": (-100.0, 100.0), "grip.pos": (0.0, 100.0)},
    "so101_follower",
)
SPREAD = statistics(LOW, HIGH)


def scaled(factor: float, low: tuple[float, ...] = LOW, high: tuple[float, ...] = HIGH) -> Vectors:
    return statistics([each * factor for each in low], [each * factor for each in high])


def without(stats: Vectors, *kinds: str) -> Vectors:
    return {kind: each for kind, each in stats.items() if kind not in kinds}


def checkpoint(**changed: Any) -> dict[str, dict[str, Any]]:
    return {"checkpoint": changed}


def dataset(**changed: Any) -> dict[str, dict[str, Any]]:
    return {"dataset": changed}


def processors(state: Vectors = SPREAD, action: Vectors = SPREAD) -> dict[str, dict[str, Any]]:
    both = {STATE: state, ACTION: action}
    return checkpoint(before=both, after=both)


def modes(before: str = "MEAN_STD", after: str = "MEAN_STD", config: str = "MEAN_STD", kind: str = "ACTION") -> Any:
    changed = {"modes": config, "before_modes": before, "after_modes": after}
    return checkpoint(**{key: {**MODES, kind: mode} for key, mode in changed.items()})


RADIANS, POSE = scaled(math.pi / 180), statistics((0.1, -0.2, 0.05), (0.4, 0.2, 0.3))
UNIT = statistics((-1.0, -1.0, 0.0), (1.0, 1.0, 1.0))
DELTAS = statistics((-4.0, -3.0, 0.0), (4.0, 3.0, 100.0))
HELD = {STATE: SPREAD, ACTION: SPREAD}

MISMATCHES: dict[str, tuple[dict[str, dict[str, Any]], str]] = {
    "the postprocessor has no statistics": (checkpoint(after={}), "statistics of action"),
    "the postprocessor has those of the state alone": (checkpoint(after={STATE: SPREAD}), "statistics of action"),
    "the preprocessor has no statistics": (checkpoint(before={}), "statistics of observation.state"),
    "the postprocessor lacks what its mode needs": (
        checkpoint(after={ACTION: without(SPREAD, "std")}),
        "statistics of action",
    ),
    "the postprocessor has bounds missing for MIN_MAX": (
        checkpoint(
            after={ACTION: without(SPREAD, "max")},
            **{name: {**MODES, "ACTION": "MIN_MAX"} for name in ("modes", "before_modes", "after_modes")},
        ),
        "statistics of action",
    ),
    "the statistics are not finite": (
        checkpoint(after={ACTION: {**SPREAD, "mean": [math.nan] * 3}}),
        "statistics of action",
    ),
    "the state's statistics are of more joints": (
        checkpoint(before={STATE: statistics(-90, 90, 4), ACTION: SPREAD}),
        "state size",
    ),
    "the action's statistics are of fewer joints": (checkpoint(after={ACTION: statistics(-90, 90, 2)}), "action size"),
    "the checkpoint's state is in radians": (processors(state=RADIANS), "range of observation.state"),
    "the checkpoint's state is normalised": (processors(state=UNIT), "range of observation.state"),
    "the checkpoint's actions are in radians": (processors(action=RADIANS), "range of action"),
    "the checkpoint's actions are of other joints": (
        processors(action=statistics((300.0, 300.0, 0.0), (400.0, 400.0, 100.0))),
        "range of action",
    ),
    "the processors are of two trainings": (
        checkpoint(before={STATE: SPREAD, ACTION: RADIANS}, after=HELD),
        "range of action",
    ),
    "the data is in radians": (dataset(low=RADIANS["min"], high=RADIANS["max"]), "range of observation.state"),
    "the data's actions are changes": (dataset(action=DELTAS), "range of action"),
    "everything has changes for actions": (
        {**processors(action=DELTAS), **dataset(action=DELTAS)},
        "actions and states",
    ),
    "everything has small changes for actions": (
        {**processors(action=UNIT), **dataset(action=UNIT)},
        "range of the actions",
    ),
    "everything has poses, declared as degrees": (
        {**processors(POSE, POSE), **dataset(low=POSE["min"], high=POSE["max"])},
        "range of the actions",
    ),
    "everything has radians, declared as degrees": (
        {**processors(RADIANS, RADIANS), **dataset(low=RADIANS["min"], high=RADIANS["max"])},
        "range of the actions",
    ),
    "everything has encoder counts, declared as degrees": (
        {**processors(scaled(20), scaled(20)), **dataset(low=scaled(20)["min"], high=scaled(20)["max"])},
        "range of the actions",
    ),
    "the data is of a Koch arm": (dataset(robot="koch_follower"), "robot type"),
    "the data is of two arms": (dataset(robot="bi_so101_follower"), "robot type"),
    "the data is of an ALOHA": (dataset(robot="aloha"), "robot type"),
    "the postprocessor uses MIN_MAX": (modes(after="MIN_MAX"), "normalisation of ACTION"),
    "the preprocessor uses MIN_MAX of the state": (
        modes(before="MIN_MAX", kind="STATE"),
        "normalisation of STATE",
    ),
    "the configuration says MIN_MAX": (modes(config="MIN_MAX"), "normalisation of ACTION"),
    "the postprocessor does not normalise": (modes(after="IDENTITY"), "normalisation of ACTION"),
    "the data has no pictures": (dataset(images={}), f"data of {FRONT}"),
    "the data has another camera": (
        dataset(images={"observation.images.wrist": (3, 96, 128)}),
        f"data of {FRONT}",
    ),
    "the data's pictures have another size": (dataset(images={FRONT: (3, 480, 640)}), f"data of {FRONT}"),
    "a picture is renamed to another key": (
        checkpoint(renamed={FRONT: "observation.images.top"}),
        f"data of {FRONT}",
    ),
}


def found(
    folder: Path, version: str, changed: Mapping[str, Mapping[str, Any]], robot: RobotFacts = ROBOT
) -> PolicyCheck:
    profile = written(folder, version, changed)
    return check_policy(profile, statements_of(profile), robot)


def written(folder: Path, version: str, changed: Mapping[str, Mapping[str, Any]], *, data: bool = True) -> Profile:
    """A profile with a checkpoint and a dataset that fit, but for what is changed."""
    write_checkpoint(folder / "checkpoint", **{"before": HELD, "after": HELD, **changed.get("checkpoint", {})})
    usual = {"low": LOW, "high": HIGH, "robot": "so101_follower"}
    write_dataset(folder / "dataset", list(KEYS), version=version, **{**usual, **changed.get("dataset", {})})
    return Profile(
        "pick",
        "lerobot_local",
        KEYS,
        KEYS,
        checkpoint=str(folder / "checkpoint"),
        dataset=str(folder / "dataset") if data else "",
        units={"": "degrees", "grip.pos": "percent"},
        rate=30.0,
        cameras=(CameraMap("front", FRONT, (96, 128)),),
    )


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
@pytest.mark.parametrize(("changed", "question"), MISMATCHES.values(), ids=MISMATCHES)
def test_a_mismatch_of_two_sources_keeps_the_robot_from_moving(
    tmp_path: Path, version: str, changed: dict[str, dict[str, Any]], question: str
) -> None:
    check = found(tmp_path, version, changed)
    assert not check.passed
    rows = [row for row in check.failures if row.question == question]
    assert rows, check.refusal()
    assert all("(" in row.policy or "(" in row.robot for row in rows), "whose value it is"
    assert all(row.change for row in rows)


def test_there_are_sixty_of_them() -> None:
    assert 2 * len(MISMATCHES) >= 60


GOOD: dict[str, tuple[dict[str, dict[str, Any]], RobotFacts]] = {
    "everything agrees": ({}, ROBOT),
    "an arm of the same family": (dataset(robot="so100"), ROBOT),
    "data of a part of the range": (processors(scaled(0.8), scaled(0.8)), ROBOT),
    "a gripper that never moved": (
        processors(*[statistics(LOW, (90.0, 80.0, 0.0))] * 2) | dataset(low=LOW, high=(90.0, 80.0, 0.0)),
        replace(ROBOT, state={**ROBOT.state, "grip.pos": 1.0}),
    ),
    "a joint that never moved": (
        processors(*[statistics((-90.0, 5.0, 0.0), (90.0, 5.0, 100.0))] * 2)
        | dataset(low=(-90.0, 5.0, 0.0), high=(90.0, 5.0, 100.0)),
        replace(ROBOT, state={**ROBOT.state, "lift.pos": 3.0}),
    ),
    "a joint that stood still, but for noise": (
        processors(*[statistics((-90.0, 5.0, 0.0), (90.0, 5.00001, 100.0))] * 2)
        | dataset(low=(-90.0, 5.00003, 0.0), high=(90.0, 5.0002, 100.0)),
        replace(ROBOT, state={**ROBOT.state, "lift.pos": 3.0}),
    ),
    "a leader that turns further than its follower": (
        processors(action=statistics((-125.0, -115.0, 0.0), (125.0, 115.0, 104.0))),
        ROBOT,
    ),
    "a robot in radians": (
        {},
        replace(
            ROBOT,
            state={"pan.pos": 0.1, "lift.pos": 0.2, "grip.pos": 3.0},
            units={"pan.pos": "radians", "lift.pos": "radians", "grip.pos": "percent"},
            ranges={"pan.pos": (-1.92, 1.92), "lift.pos": (-1.75, 1.75), "grip.pos": (0.0, 100.0)},
        ),
    ),
    "MIN_MAX everywhere": (modes("MIN_MAX", "MIN_MAX", "MIN_MAX"), ROBOT),
    "a policy that normalises nothing": (
        checkpoint(
            before={},
            after={},
            **dict.fromkeys(("modes", "before_modes", "after_modes"), dict.fromkeys(MODES, "IDENTITY")),
        ),
        ROBOT,
    ),
    "a picture that is renamed": (
        checkpoint(renamed={"observation.images.webcam": FRONT})
        | dataset(images={"observation.images.webcam": (3, 96, 128)}),
        ROBOT,
    ),
    "a second camera of the data that the policy does not see": (
        dataset(images={FRONT: (3, 96, 128), "observation.images.wrist": (3, 96, 128)}),
        ROBOT,
    ),
}


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
@pytest.mark.parametrize(("changed", "robot"), GOOD.values(), ids=GOOD)
def test_a_policy_whose_sources_agree_passes(
    tmp_path: Path, version: str, changed: dict[str, dict[str, Any]], robot: RobotFacts
) -> None:
    check = found(tmp_path, version, changed, robot)
    assert check.passed, check.refusal()


def test_the_checkpoints_own_bounds_count_where_no_dataset_is_named(tmp_path: Path) -> None:
    profile = written(tmp_path, "v3.0", processors(RADIANS, RADIANS), data=False)
    check = check_policy(profile, statements_of(profile), replace(ROBOT, state={**ROBOT.state, "pan.pos": 60.0}))
    assert {"state in the data", "range of the actions"} <= {row.question for row in check.failures}
    assert "(policy_preprocessor.json)" in check.refusal()


def in_type(folder: Path, profile: Profile, dtype: str, held: Mapping[str, Vectors]) -> PolicyCheck:
    """The check of a checkpoint whose statistics are numbers of another type."""
    tensors = {f"{feature}.{kind}": each for feature, kinds in held.items() for kind, each in kinds.items()}
    for path in (folder / "checkpoint").glob("policy_*.safetensors"):
        write_safetensors(path, tensors, dtype)
    return check_policy(profile, statements_of(profile), ROBOT)


def test_statistics_in_bf16_are_read(tmp_path: Path) -> None:
    profile = written(tmp_path, "v3.0", {})
    check = in_type(tmp_path, profile, "BF16", HELD)
    assert check.passed, check.refusal()
    radians = in_type(tmp_path, profile, "BF16", {STATE: RADIANS, ACTION: RADIANS})
    assert {"range of observation.state", "range of action"} <= {row.question for row in radians.failures}


def test_statistics_of_an_unknown_type_are_there_with_unknown_values(tmp_path: Path) -> None:
    profile = written(tmp_path, "v3.0", {})
    check = in_type(tmp_path, profile, "F8_E4M3", HELD)
    assert check.passed, check.refusal()
    lacking = in_type(tmp_path, profile, "F8_E4M3", {STATE: SPREAD, ACTION: without(SPREAD, "std")})
    assert "statistics of action" in {row.question for row in lacking.failures}


WIDE = replace(ROBOT, ranges={**ROBOT.ranges, "pan.pos": (-360.0, 360.0), "lift.pos": (-360.0, 360.0)})


def outcomes(profile: Profile, robot: RobotFacts) -> tuple[dict[str, set[str]], bool]:
    check = check_policy(profile, statements_of(profile), robot)
    found: dict[str, set[str]] = {}
    for row in check.rows:
        found.setdefault(row.question, set()).add(row.outcome)
    return found, check.passed


def moving(low: float, high: float) -> dict[str, dict[str, Any]]:
    """Sources that agree on the range of both joints."""
    spread = statistics((low, low, 0.0), (high, high, 100.0))
    return {**processors(spread, spread), **dataset(low=spread["min"], high=spread["max"])}


def test_small_motions_of_joints_that_turn_widely_are_positions(tmp_path: Path) -> None:
    rows, passed = outcomes(written(tmp_path, "v3.0", moving(-13.0, 13.0)), WIDE)
    assert rows["range of the actions"] == {"ok"}
    assert passed


def test_very_small_motions_may_be_vouched_for_but_changes_may_not(tmp_path: Path) -> None:
    profile = written(tmp_path / "small", "v3.0", moving(-2.0, 3.0))
    rows, passed = outcomes(profile, WIDE)
    assert rows["range of the actions"] == {"unverified"}
    assert not passed
    vouched = replace(profile, confirmed=frozenset({"units"}))
    assert outcomes(vouched, WIDE)[1]
    changes = written(tmp_path / "changes", "v3.0", {**processors(action=UNIT), **dataset(action=UNIT)})
    rows, passed = outcomes(replace(changes, confirmed=frozenset({"units"})), WIDE)
    assert rows["range of the actions"] == {"refused"}
    assert not passed


def test_training_on_more_than_the_named_data_may_be_vouched_for(tmp_path: Path) -> None:
    part = {key: tuple(each / 4 for each in bounds) for key, bounds in (("low", LOW), ("high", HIGH))}
    profile = written(tmp_path, "v3.0", dataset(**part))
    rows, passed = outcomes(profile, ROBOT)
    assert rows["range of action"] == {"ok", "unverified"}, "the processors agree"
    assert not passed
    assert outcomes(replace(profile, confirmed=frozenset({"units"})), ROBOT)[1]


def test_ranges_in_two_units_and_disjoint_ones_cannot_be_vouched_for(tmp_path: Path) -> None:
    other = statistics((300.0, 300.0, 0.0), (400.0, 400.0, 100.0))
    for name, action in (("radians", RADIANS), ("normalised", UNIT), ("disjoint", other)):
        profile = replace(written(tmp_path / name, "v3.0", processors(action=action)), confirmed=frozenset({"units"}))
        assert "refused" in outcomes(profile, ROBOT)[0]["range of action"], name


def test_quantiles_are_not_compared_with_bounds(tmp_path: Path) -> None:
    quantiles = {"q01": [-9.0, -8.0, 0.0], "q99": [9.0, 8.0, 10.0]}
    profile = written(tmp_path, "v3.0", processors(*[{**without(SPREAD, "min", "max"), **quantiles}] * 2))
    check = check_policy(profile, statements_of(profile), ROBOT)
    said = [row for row in check.unanswered if row.question == "range of action"]
    assert said
    assert {"quantiles", "bounds"} == {side.split()[0] for row in said for side in (row.policy, row.robot)}
    assert not any(row.question.startswith("range of ") for row in check.failures), check.refusal()


@pytest.mark.parametrize(("more", "read"), [(0, True), (1, False)])
def test_the_greatest_number_of_episodes_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, more: int, read: bool
) -> None:
    monkeypatch.setattr("strands_robots.policies.checkpoint.EPISODES_MAX", 4)
    profile = written(tmp_path, "v2.1", {})
    path = tmp_path / "dataset" / "meta" / "episodes_stats.jsonl"
    lines = path.read_text().splitlines() * 2
    path.write_text("\n".join(lines + lines[:more]) + "\n")
    assert check_policy(profile, statements_of(profile), ROBOT).passed is read


UNANSWERED: dict[str, tuple[dict[str, dict[str, Any]], RobotFacts, bool, str]] = {
    "no dataset, so no order": ({}, ROBOT, False, "state order"),
    "no dataset, so no order of actions": ({}, ROBOT, False, "action order"),
    "no dataset, so no rate": ({}, ROBOT, False, "rate of the data"),
    "no dataset, so no pictures": ({}, ROBOT, False, "pictures of the data"),
    "no dataset, so no robot": ({}, ROBOT, False, "robot type"),
    "a dataset that names no robot": (dataset(robot=None), ROBOT, True, "robot type"),
    "a robot of an unknown type": ({}, replace(ROBOT, kind=""), True, "robot type"),
    "a robot whose joints have no ranges": ({}, replace(ROBOT, ranges={}), True, "range of the actions"),
    "no bounds anywhere": (
        processors(without(SPREAD, "min", "max"), without(SPREAD, "min", "max")) | dataset(statistics_of=()),
        ROBOT,
        True,
        "state in the data",
    ),
    "nothing says how numbers are normalised": (
        checkpoint(modes=None, before_modes=None, after_modes=None),
        ROBOT,
        True,
        "normalisation of ACTION",
    ),
}


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
@pytest.mark.parametrize(("changed", "robot", "data", "question"), UNANSWERED.values(), ids=UNANSWERED)
def test_a_question_that_no_source_answers_is_a_row(
    tmp_path: Path, version: str, changed: dict[str, dict[str, Any]], robot: RobotFacts, data: bool, question: str
) -> None:
    profile = written(tmp_path, version, changed, data=data)
    check = check_policy(profile, statements_of(profile), robot)
    assert question in {row.question for row in check.unanswered}
    assert check.passed, check.refusal()


def test_another_robots_data_may_be_vouched_for(tmp_path: Path) -> None:
    profile = written(tmp_path, "v3.0", dataset(robot="my_arm"))
    assert not check_policy(profile, statements_of(profile), ROBOT).passed
    vouched = replace(profile, confirmed=frozenset({"robot type"}))
    assert check_policy(vouched, statements_of(vouched), ROBOT).passed


@pytest.mark.parametrize("line", ["{", "[]", json.dumps({"episode_index": 0}), "x" * 300_000])
def test_statistics_of_an_episode_that_cannot_be_read_are_refused(tmp_path: Path, line: str) -> None:
    profile = written(tmp_path, "v2.1", {})
    with (tmp_path / "dataset" / "meta" / "episodes_stats.jsonl").open("a") as file:
        file.write(line + "\n")
    check = check_policy(profile, statements_of(profile), ROBOT)
    assert "episodes_stats.jsonl" in check.refusal()


class Still:
    """A policy that answers nothing."""

    uses_cameras = False

    def reset(self, instruction: str, ranges: Any) -> None: ...

    def act(self, observation: Any) -> None: ...

    def interrupt(self) -> None: ...

    def close(self) -> None: ...


def test_the_log_names_the_profile_and_what_no_source_states(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING)
    policy = ProfiledPolicy(written(tmp_path, "v3.0", dataset(robot=None)), Still())
    policy.fit(ROBOT)
    policy.fit(ROBOT)
    (said,) = [record.getMessage() for record in caplog.records]
    assert said == "pick moves arm, and no source states: robot type."
    policy.close()


def test_a_mismatch_is_refused_before_the_policy_is_loaded(tmp_path: Path) -> None:
    policy = ProfiledPolicy(written(tmp_path, "v3.0", checkpoint(after={})), Still())
    with pytest.raises(PolicyCheckError, match=r"statistics of action is refused: .*policy_postprocessor.json"):
        policy.fit(ROBOT)
    policy.close()
