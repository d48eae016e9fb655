"""From a scripted expert to a trained policy, on this machine: record, convert, train, serve, evaluate.

The expert reaches for points in simulation and is recorded. LeRobot's own writer makes a dataset of the recordings, a
small ACT is trained on it, and a profile describes it. Then the policy is evaluated beside ``mock``, computed in this
process and by a server that speaks openpi's protocol. Needs `make lerobot`:

    .venv-policies/bin/python examples/train_reach.py reach-output
"""

from __future__ import annotations

import argparse
import logging
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from datasets.utils.logging import disable_progress_bar
from examples.openpi_server import serve_checkpoint
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.factory import make_pre_post_processors

from strands_robots.evaluation import Episode, run_episode, table_of
from strands_robots.recording.file import STEP, RecordedEvent, read_items

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
TARGET = ("target.x", "target.y", "target.z")
FPS, CHUNK, BATCH = 25, 20, 64
FIRST_SEED = 100_000
"""Seeds of the recordings, so that none is evaluated."""


def record(folder: Path, episodes: int) -> list[Path]:
    """Record the expert; an episode that failed is left out."""
    folder.mkdir(parents=True)
    files = []
    for index in range(episodes):
        file = folder / f"{index:04}.mcap"
        if run_episode("expert:reach", "reach", FIRST_SEED + index, hz=FPS, recording=file).success:
            files.append(file)
    return files


def convert(files: list[Path], folder: Path) -> LeRobotDataset:
    """Write a dataset (v3) of the recordings with LeRobot's own writer."""
    names = {"observation.state": JOINTS, "observation.environment_state": TARGET, "action": JOINTS}
    features = {key: {"dtype": "float32", "shape": (len(own),), "names": list(own)} for key, own in names.items()}
    dataset = LeRobotDataset.create("local/reach", FPS, features, root=folder, robot_type="so100", use_videos=False)
    for file in files:
        # The expert tells only the joints that it moves; the others keep what they were told, or where they are.
        told: dict[str, float] = {}
        for item in read_items(file):
            if isinstance(item, RecordedEvent) and item.event == STEP:
                seen = item.payload["observation"]
                told = {**seen, **told, **item.payload["action"]}
                vectors = {
                    "observation.state": [seen[key] for key in JOINTS],
                    "observation.environment_state": [seen[key] for key in TARGET],
                    "action": [told[key] for key in JOINTS],
                }
                frame = {key: np.array(values, np.float32) for key, values in vectors.items()}
                dataset.add_frame({**frame, "task": "move the tip to the target"})
        dataset.save_episode()
    dataset.finalize()
    return LeRobotDataset("local/reach", root=folder)


def batches(dataset: LeRobotDataset, steps: int) -> Iterator[dict[str, Any]]:
    """Draw frames at random, each with its next actions; those beyond its episode are padded."""
    rows = dataset.hf_dataset.with_format("torch")
    columns = {key: torch.stack(list(rows[key])) for key in ("observation.state", "observation.environment_state")}
    actions, episode = torch.stack(list(rows["action"])), torch.stack(list(rows["episode_index"]))
    last = torch.tensor([int((episode == each).nonzero().max()) for each in range(int(episode.max()) + 1)])
    draw = torch.Generator().manual_seed(1)
    for _ in range(steps):
        at = torch.randint(len(actions), (BATCH,), generator=draw)
        ahead = at[:, None] + torch.arange(CHUNK)
        end = last[episode[at]][:, None]
        chunk = {"action": actions[ahead.minimum(end)], "action_is_pad": ahead > end}
        yield {**{key: values[at] for key, values in columns.items()}, **chunk}


def train(dataset: LeRobotDataset, folder: Path, steps: int) -> None:
    """Train a small ACT without pictures, and save it with its processors."""
    joints = (len(JOINTS),)
    config = ACTConfig(
        input_features={
            "observation.state": PolicyFeature(FeatureType.STATE, joints),
            "observation.environment_state": PolicyFeature(FeatureType.ENV, (len(TARGET),)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, joints)},
        chunk_size=CHUNK,
        n_action_steps=CHUNK,
        dim_model=128,
        n_heads=4,
        dim_feedforward=512,
        n_encoder_layers=2,
        n_decoder_layers=1,
        use_vae=False,
        dropout=0.0,
        device="cpu",
        push_to_hub=False,
    )
    torch.manual_seed(1)
    # So small a network is slower on several threads.
    torch.set_num_threads(1)
    policy = ACTPolicy(config)
    before, after = make_pre_post_processors(config, dataset_stats=dataset.meta.stats)
    optimizer = torch.optim.AdamW(policy.parameters(), lr=5e-4, weight_decay=1e-4)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 1e-3, total_steps=steps)
    policy.train()
    began = time.monotonic()
    for number, batch in enumerate(batches(dataset, steps)):
        loss, _ = policy.forward(before(batch))
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(policy.parameters(), 10.0)
        optimizer.step()
        schedule.step()
        if number % 500 == 0:
            print(f"step {number}: loss {loss.item():.4f}, {time.monotonic() - began:.0f} s", flush=True)
    for each in (policy, before, after):
        each.save_pretrained(folder)


def profiles(file: Path, checkpoint: Path, dataset: Path, url: str) -> None:
    """Describe the policy twice: computed in this process, and by a server."""
    joints, target = str(list(JOINTS)).replace("'", '"'), str(list(TARGET)).replace("'", '"')
    units = 'units = { default = "radians", "target.x" = "metres", "target.y" = "metres", "target.z" = "metres" }'
    both = f"action = {joints}\n{units}\nrate = {FPS}\nhorizon = 10\nmax_speed = 1.0\n"
    file.write_text(
        f'[reach-act]\nprovider = "lerobot_local"\ncheckpoint = "{checkpoint}"\ndataset = "{dataset}"\n'
        f"state = {joints}\nenvironment = {target}\n{both}\n"
        f'[reach-openpi]\nprovider = "openpi"\nurl = "{url}"\n'
        f"state = {joints[:-1]}, {target[1:]}\n{both}"
    )


def main() -> None:
    """Go the whole way, and print the success rates."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--recordings", type=int, default=200)
    parser.add_argument("--steps", type=int, default=2500)
    parser.add_argument("--episodes", type=int, default=50)
    options = parser.parse_args()
    folder: Path = options.folder.resolve()
    logging.disable(logging.WARNING)
    disable_progress_bar()

    files = record(folder / "recordings", options.recordings)
    print(f"{len(files)} of {options.recordings} recordings succeeded.")
    dataset = convert(files, folder / "dataset")
    print(f"Dataset: {dataset.num_episodes} episodes, {dataset.num_frames} frames at {dataset.fps} Hz.")
    train(dataset, folder / "act", options.steps)

    with serve_checkpoint(folder / "act", state=len(JOINTS)) as url:
        profiles(folder / "policies.toml", folder / "act", folder / "dataset", url)
        os.environ["STRANDS_POLICIES"] = str(folder / "policies.toml")
        found: dict[str, list[Episode]] = {}
        for name in ("mock", "expert:reach", "reach-act", "reach-openpi"):
            found[name] = [run_episode(name, "reach", seed) for seed in range(options.episodes)]
            print(table_of({name: found[name]}).splitlines()[-1], flush=True)
        print(table_of(found))


if __name__ == "__main__":
    main()
