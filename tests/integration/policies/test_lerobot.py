"""LeRobot's own policies with random weights, from a directory to actions. Run by `make lerobot`."""

from __future__ import annotations

import importlib.util
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy
import pytest
from fixtures.bodies import StepClock
from fixtures.ending import NAMED, ended

from strands_robots.evaluation import run_episode
from strands_robots.policies import create_policy
from strands_robots.policies.base import PolicyError
from strands_robots.policies.bench import StillBody
from strands_robots.policies.check import PolicyCheckError
from strands_robots.policies.profiled import ProfiledPolicy
from strands_robots.policies.profiles import load_profiles
from strands_robots.policies.rollout import Rollout
from strands_robots.safety.gate import MotionGate

if importlib.util.find_spec("torch") is None or importlib.util.find_spec("lerobot") is None:
    pytest.skip("LeRobot with torch is not installed; `make lerobot` runs this", allow_module_level=True)

import torch
from examples import train_reach
from examples.openpi_server import serve_checkpoint
from fixtures import lerobot_checkpoints as tiny
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from lerobot.policies.utils import prepare_observation_for_inference
from safetensors.torch import load_file, save_file

JOINTS = ["pan", "lift", "grip"]
AROUND = ["cube.x", "cube.y"]
STATE = {"pan": 3.0, "lift": -20.0, "grip": 40.0}
CUBE = {"cube.x": 10.0, "cube.y": -5.0}
HZ = 30.0

Make = Callable[..., ProfiledPolicy]


@pytest.fixture
def make(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Make:
    """A loaded policy of a checkpoint, with a profile's entries changed."""

    def made(checkpoint: Path, *, cameras: str = "", **changed: Any) -> ProfiledPolicy:
        entries = {"state": JOINTS, "action": JOINTS, "units": "degrees", "rate": HZ, "device": "cpu"}
        if not cameras:
            entries["environment"] = AROUND
        entries |= {"provider": "lerobot", "checkpoint": str(checkpoint)} | changed
        lines = [f"{key} = {json.dumps(value)}" for key, value in entries.items() if value is not None]
        file = tmp_path / f"{checkpoint.name}-{len(list(tmp_path.iterdir()))}.toml"
        file.write_text("\n".join(["[tiny]", *lines, cameras]))
        monkeypatch.setenv("STRANDS_POLICIES", str(file))
        policy = create_policy("tiny")
        assert isinstance(policy, ProfiledPolicy)
        policy.load(StillBody(load_profiles(file)["tiny"]).facts(HZ), 60.0)
        return policy

    return made


def played(policy: ProfiledPolicy, steps: int, **pictures: Any) -> list[dict[str, float]]:
    """The actions of a rollout on a clock that is moved by hand."""
    clock, written = StepClock(), list[dict[str, float]]()
    body = StillBody(policy.profile)
    body._joints |= STATE | CUBE
    body._pictures |= pictures
    body.send_action = lambda action, permit: written.append(dict(action)) or action
    policy.compute_inline(clock.now)
    Rollout(body, policy, permit=MotionGate().permit("test"), hz=HZ, clock=clock, steps=steps).run()
    return written


def directly(checkpoint: Path, frame: dict[str, Any]) -> Any:
    """The chunk that LeRobot's own calls answer."""
    config = PreTrainedConfig.from_pretrained(checkpoint)
    model = get_policy_class(config.type).from_pretrained(checkpoint, config=config)
    before, after = make_pre_post_processors(config, pretrained_path=str(checkpoint))
    with torch.inference_mode():
        batch = before(prepare_observation_for_inference(frame, torch.device("cpu"), "", ""))
        return after(model.predict_action_chunk(batch))[0].numpy()


def vector(values: dict[str, float]) -> Any:
    return numpy.array(list(values.values()), numpy.float32)


def test_act_plays_the_chunk_that_lerobot_computes(make: Make, tmp_path: Path) -> None:
    checkpoint = tiny.act(tmp_path / "act")
    written = played(make(checkpoint, max_speed=10.0), 10)
    expected = directly(checkpoint, {tiny.STATE: vector(STATE), tiny.ENVIRONMENT: vector(CUBE)})
    assert numpy.array([list(action.values()) for action in written]) == pytest.approx(expected, abs=1e-3)
    assert list(written[0]) == JOINTS


def test_state_and_actions_are_in_the_order_of_the_profile_and_not_of_the_robot(make: Make, tmp_path: Path) -> None:
    checkpoint = tiny.act(tmp_path / "act")
    turned = list(reversed(JOINTS))
    written = played(make(checkpoint, state=turned, action=turned, max_speed=10.0), 1)
    state = numpy.array([STATE[key] for key in turned], numpy.float32)
    expected = directly(checkpoint, {tiny.STATE: state, tiny.ENVIRONMENT: vector(CUBE)})[0]
    assert written[0] == pytest.approx(dict(zip(turned, map(float, expected), strict=True)), abs=1e-3)


def test_act_sees_the_picture_of_the_camera_that_the_profile_names(make: Make, tmp_path: Path) -> None:
    key = "observation.images.front"
    checkpoint = tiny.act(tmp_path / "act", images={key: (96, 128)})
    image = numpy.random.default_rng(1).integers(0, 255, (96, 128, 3), numpy.uint8)
    cameras = f'[tiny.cameras.webcam]\nkey = "{key}"\nsize = [96, 128]'
    written = played(make(checkpoint, cameras=cameras, max_speed=10.0), 3, webcam=image)
    expected = directly(checkpoint, {tiny.STATE: vector(STATE), key: image})
    assert list(written[0].values()) == pytest.approx(list(expected[0]), abs=1e-3)
    with pytest.raises(PolicyCheckError, match=r"set cameras.webcam.size = \[96, 128\]"):
        make(checkpoint, cameras=f'[tiny.cameras.webcam]\nkey = "{key}"\nsize = [48, 64]')


@pytest.mark.parametrize("kind", ["diffusion", "ensembling"])
def test_a_policy_that_needs_every_observation_gets_every_one(make: Make, tmp_path: Path, kind: str) -> None:
    ensembling = {"temporal_ensemble_coeff": 0.01, "n_action_steps": 1}
    checkpoint = (
        tiny.diffusion(tmp_path / "policy") if kind == "diffusion" else tiny.act(tmp_path / "policy", **ensembling)
    )
    policy = make(checkpoint)
    written = played(policy, 12)
    assert len(written) == 12
    assert policy.counts()["inferences"] == 12
    assert policy.counts()["underruns"] == 0


FRONT = "observation.images.front"
WEBCAM = f'[tiny.cameras.webcam]\nkey = "{FRONT}"\nsize = [64, 64]'


def test_smolvla_plays_its_chunks_and_is_told_the_task(
    make: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    checkpoint = tiny.smolvla(tmp_path / "smolvla", images={FRONT: (64, 64)})
    policy = make(checkpoint, cameras=WEBCAM, task="pick up the cube", horizon=5)
    written = played(policy, 12, webcam=numpy.zeros((64, 64, 3), numpy.uint8))
    assert (len(written), policy.counts()["inferences"]) == (12, 3)


def test_with_real_time_chunking_a_chunk_goes_on_from_the_last_one(
    make: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    checkpoint = tiny.smolvla(tmp_path / "smolvla", images={FRONT: (64, 64)})
    image = numpy.zeros((64, 64, 3), numpy.uint8)
    seams = {}
    for rtc in (False, True):
        torch.manual_seed(3)
        policy = make(checkpoint, cameras=WEBCAM, task="pick up the cube", rtc=rtc)
        policy.reset("x", dict.fromkeys(JOINTS, (-1000000000.0, 1000000000.0)))
        inner, seen = policy._inner, {**STATE, "front": image}
        first = inner.act_on(seen, played=0, delay=0) if rtc else inner.act(seen)
        second = inner.act_on(seen, played=5, delay=4) if rtc else inner.act(seen)
        old, new = ([list(action.values()) for action in part] for part in (first[5:9], second[:4]))
        seams[rtc] = float(numpy.abs(numpy.array(old) - numpy.array(new)).max())
        policy.close()
    # SmolVLA draws its noise anew for each chunk; with chunking, what is played meanwhile stays as it was.
    assert seams[True] < 0.2 * seams[False]


def test_a_type_without_real_time_chunking_says_so(make: Make, tmp_path: Path) -> None:
    with pytest.raises(PolicyError, match="type act has no real-time chunking"):
        make(tiny.act(tmp_path / "act"), rtc=True)


def test_absent_weights_are_refused_and_never_random(make: Make, tmp_path: Path) -> None:
    checkpoint = tiny.act(tmp_path / "act")
    weights = load_file(checkpoint / "model.safetensors")
    weights.pop(next(key for key in weights if "action_head" in key))
    save_file(weights, checkpoint / "model.safetensors")
    with pytest.raises(PolicyError, match="could not be loaded"):
        make(checkpoint)


def test_a_checkpoint_without_its_statistics_is_refused(make: Make, tmp_path: Path) -> None:
    checkpoint = tiny.act(tmp_path / "act")
    for file in checkpoint.glob("policy_*.safetensors"):
        save_file({key: value for key, value in load_file(file).items() if "action" not in key}, file)
    with pytest.raises(PolicyCheckError, match="statistics of action is refused"):
        make(checkpoint)


def test_an_environment_of_another_size_is_refused(make: Make, tmp_path: Path) -> None:
    checkpoint = tiny.act(tmp_path / "act")
    with pytest.raises(PolicyCheckError, match="environment size"):
        make(checkpoint, environment=["cube.x"])


def test_a_process_that_ends_while_torch_computes_keeps_its_exit_code() -> None:
    # Each product comes back to Python, which ends the thread there once the interpreter shuts down.
    computes = "import torch; one = torch.rand(500, 500)\n    while True: one @ one"
    process = ended(computes, "import torch; sys.exit(3)")
    assert NAMED.fullmatch(process.stderr), process.stderr
    assert process.returncode == 3


def test_a_checkpoint_is_used_through_a_profile_alone(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="needs a profile"):
        create_policy("lerobot_local", pretrained_name_or_path=str(tmp_path))


def test_the_way_from_an_expert_to_a_trained_policy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files = train_reach.record(tmp_path / "recordings", 2)
    assert len(files) == 2
    dataset = train_reach.convert(files, tmp_path / "dataset")
    info = json.loads((tmp_path / "dataset" / "meta" / "info.json").read_text())
    assert info["codebase_version"] == "v3.0"
    assert (dataset.num_episodes, info["fps"], info["features"]["action"]["names"]) == (2, 25, list(train_reach.JOINTS))
    train_reach.train(dataset, tmp_path / "act", 10)
    with serve_checkpoint(tmp_path / "act", state=6) as url:
        train_reach.profiles(tmp_path / "policies.toml", tmp_path / "act", tmp_path / "dataset", url)
        monkeypatch.setenv("STRANDS_POLICIES", str(tmp_path / "policies.toml"))
        here, there = (run_episode(name, "reach", 1) for name in ("reach-act", "reach-openpi"))
    assert (here.error, there.error) == ("", "")
    assert here.loop["inferences"] == there.loop["inferences"] > 10
    assert here.seconds == pytest.approx(there.seconds), "the wire changes nothing"
