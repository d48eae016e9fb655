"""The same policy trained on our recording and on LeRobot's own, and both evaluated on common seeds.

``python -m benchmarks.dataset_training FOLDER RECORDINGS STEPS SEEDS`` in the environment of
``scripts/lerobot.sh 0.6.1`` prints the successes of both, by seed.
"""

from __future__ import annotations

import json
import logging
import os
import sys
import time
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from importlib import import_module
from io import StringIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from fixtures.child import Child
from fixtures.waiting import free_port
from rich.console import Console

from benchmarks.dataset_expert import CUBE, JOINTS, PEER, TASK, CubeArm
from strands_robots.cli.dataset import served_robot
from strands_robots.cli.dataset_recording import Attempts, record_attempts
from strands_robots.cli.network import Network
from strands_robots.cli.output import Screen
from strands_robots.datasets.session import RecordingSession
from strands_robots.device_connect import loopback_config
from strands_robots.evaluation import run_episode

FPS = 25
"""As examples/train_reach.py trains."""

FIRST_SEED = 100_000
"""Seeds of the recordings, so that none is evaluated."""

LONGEST_S = 20.0
VECTORS = {"observation.state": JOINTS, "observation.environment_state": CUBE}
HORIZON, MAX_SPEED = 10, 1.0


@dataclass
class Pushing:
    """Attempt of the expert, as it is recorded from here."""

    arm: Child
    began: float
    voided: bool = False
    error: str = ""

    @property
    def running(self) -> bool:
        """True until the expert's end."""
        return not self.arm.ask("ended")["over"] and time.monotonic() - self.began < LONGEST_S


def record_ours(folder: Path, seeds: range) -> None:
    """Record the expert over the network, as ``dataset record --robot arm-1 --leader page`` does."""
    port = free_port()
    screen = Screen(console=Console(file=StringIO()))
    with ExitStack() as stack:
        arm = stack.enter_context(Child("benchmarks.dataset_expert", {"link": asdict(loopback_config(port))}))
        far = stack.enter_context(served_robot(screen, Network(port=port), PEER, "", TASK, ["none"], None))
        session = stack.enter_context(RecordingSession(folder, FPS, TASK, "so100", lambda said: None))
        for seed in seeds:

            def begin(seed: int = seed) -> Pushing:
                far.begin(None)
                arm.ask("begin", seed)
                return Pushing(arm, time.monotonic())

            record_attempts(screen, far, session, Attempts(1, begin, FPS, None, 0.0, success=True))


def record_theirs(folder: Path, seeds: range) -> None:
    """Record the same expert with LeRobot's own writer, in a loop as its recorder has."""
    datasets: Any = import_module("lerobot.datasets.lerobot_dataset")
    keys = {"observation.state": (*JOINTS, *CUBE), "action": JOINTS}
    features = {key: {"dtype": "float32", "shape": (len(own),), "names": list(own)} for key, own in keys.items()}
    dataset = datasets.LeRobotDataset.create("local/theirs", FPS, features, root=folder, use_videos=False)
    arm = CubeArm()
    for seed in seeds:
        arm.set_up(seed, FPS)
        began, frame = time.monotonic(), 0
        while not arm.over and frame < LONGEST_S * FPS:
            seen, action = arm.get_observation(), arm.expert_action()
            arm.send_action(action)
            rows = {key: np.array([{**seen, **action}[each] for each in own], np.float32) for key, own in keys.items()}
            rows["observation.state"] = np.array([seen[each] for each in keys["observation.state"]], np.float32)
            dataset.add_frame({**rows, "task": TASK})
            frame += 1
            time.sleep(max(0.0, began + frame / FPS - time.monotonic()))
        dataset.save_episode()
    dataset.finalize()


def split(folder: Path, name: str) -> Any:
    """Return a dataset as the example's training takes it: joints and cube in vectors of their own."""
    torch: Any = import_module("torch")
    datasets: Any = import_module("lerobot.datasets.lerobot_dataset")
    dataset = datasets.LeRobotDataset(f"local/{name}", root=folder)
    names = list(dataset.meta.features["observation.state"]["names"])
    rows = dataset.hf_dataset.with_format("torch")
    state = torch.stack(list(rows["observation.state"]))
    columns = {key: rows[key] for key in ("action", "episode_index")}
    stats = {"action": ordered(dataset.meta.stats["action"], list(dataset.meta.features["action"]["names"]), JOINTS)}
    order = [list(dataset.meta.features["action"]["names"]).index(key) for key in JOINTS]
    columns["action"] = torch.stack(list(columns["action"]))[:, order]
    for key, own in VECTORS.items():
        columns[key] = state[:, [names.index(each) for each in own]]
        stats[key] = ordered(dataset.meta.stats["observation.state"], names, own)
    return SimpleNamespace(hf_dataset=SimpleNamespace(with_format=lambda _: columns), meta=SimpleNamespace(stats=stats))


def ordered(stats: Mapping[str, Any], names: list[str], own: tuple[str, ...]) -> dict[str, Any]:
    """Return the statistics of some numbers of a vector."""
    at = [names.index(each) for each in own]
    return {name: value if name == "count" else np.asarray(value)[at] for name, value in stats.items()}


def profile(name: str, url: str) -> str:
    """Return the profile of a served checkpoint."""
    metres = ", ".join(f'"{key}" = "metres"' for key in CUBE)
    return (
        f'[{name}]\nprovider = "openpi"\nurl = "{url}"\nstate = {json.dumps([*JOINTS, *CUBE])}\n'
        f'action = {json.dumps(JOINTS)}\nunits = {{ default = "radians", {metres} }}\n'
        f"rate = {FPS}\nhorizon = {HORIZON}\nmax_speed = {MAX_SPEED}\n\n"
    )


def note(done: str) -> None:
    """Say what is over and when, as all of it takes hours."""
    print(time.strftime("%H:%M:%S"), done, file=sys.stderr, flush=True)


def main() -> None:
    """Record, train, serve and evaluate both, and print their successes."""
    # Both import what this environment alone has.
    serve_checkpoint, train = (
        getattr(import_module(f"examples.{module}"), name)
        for module, name in (("openpi_server", "serve_checkpoint"), ("train_reach", "train"))
    )
    logging.disable(logging.ERROR)
    folder, (recordings, steps, seeds) = Path(sys.argv[1]), map(int, sys.argv[2:5])
    chosen = range(FIRST_SEED, FIRST_SEED + recordings)
    record_ours(folder / "ours", chosen)
    note("our recording")
    record_theirs(folder / "theirs", chosen)
    note("LeRobot's recording")
    found: dict[str, list[bool]] = {}
    for name in ("ours", "theirs"):
        train(split(folder / name, name), folder / f"{name}-act", steps)
        note(f"the training on {name}")
        with serve_checkpoint(folder / f"{name}-act", state=len(JOINTS)) as url:
            file = folder / f"{name}.toml"
            file.write_text(profile(f"{name}-act", url))
            os.environ["STRANDS_POLICIES"] = str(file)
            found[name] = [run_episode(f"{name}-act", TASK, seed).success for seed in range(seeds)]
        note(f"{sum(found[name])} of {seeds} episodes of {name}")
    print(json.dumps(found), flush=True)


if __name__ == "__main__":
    main()
