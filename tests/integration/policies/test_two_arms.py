"""The way of docs/datasets.md from two arms to a policy, on emulated ones. Run by `make lerobot-next`."""

from __future__ import annotations

import importlib.util
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from importlib.metadata import version
from itertools import cycle
from pathlib import Path

import pytest
from fixtures.command_line import Machine
from fixtures.feetech_bus import write_calibration
from fixtures.feetech_bus.process import BusProcess
from fixtures.waiting import eventually

if importlib.util.find_spec("torch") is None or importlib.util.find_spec("lerobot") is None:
    pytest.skip("LeRobot with torch is not installed; `make lerobot-next` runs this", allow_module_level=True)
if version("lerobot") < "0.6":
    pytest.skip("LeRobot 0.4.4 has no decoder of videos here; `make lerobot-next` runs this", allow_module_level=True)

from strands_robots.datasets import tables
from strands_robots.datasets.check import check_dataset
from strands_robots.datasets.layout import data_file

ROOT = Path(__file__).parents[3]
PAGE = (ROOT / "docs" / "datasets.md").read_text("utf-8").partition("## From two arms to a policy of your own")[2]
PATIENT = (sys.executable, "-m", "fixtures.feetech_bus.patient", "strands_robots.cli")
SIZE = 96

CAMERA = f"""
import time
from dataclasses import dataclass
import numpy as np
from lerobot.cameras import Camera, CameraConfig

@CameraConfig.register_subclass("moving")
@dataclass
class MovingConfig(CameraConfig):
    pass

class Moving(Camera):
    is_connected = False
    find_cameras = staticmethod(list)
    def connect(self, warmup=True):
        self.is_connected = True
    def disconnect(self):
        self.is_connected = False
    def read(self, *given, **named):
        picture = np.zeros(({SIZE}, {SIZE}, 3), dtype=np.uint8)
        picture[:, int(time.monotonic() * 20) % {SIZE}] = 255
        return picture
    async_read = read_latest = read
"""
"""Camera of the page's place: a bar that moves, from memory."""

TINY = (
    *("--steps=2", "--batch_size=2", "--num_workers=0", "--save_freq=2", "--policy.dim_model=32", "--policy.n_heads=2"),
    *("--policy.dim_feedforward=32", "--policy.n_encoder_layers=1", "--policy.n_vae_encoder_layers=1"),
    *("--policy.latent_dim=4", "--policy.pretrained_backbone_weights=null"),
)
SHORT = ("--episodes", "2", "--episode-s", "4", "--pause-s", "0", "--success")


def blocks(kind: str) -> list[str]:
    return re.findall(rf"```{kind}\n(.*?)```", PAGE, re.DOTALL)


class Desk:
    """Two emulated arms, and the page's commands on them."""

    def __init__(self, folder: Path, follower: BusProcess, leader: BusProcess) -> None:
        self.folder, self.follower, self.leader = folder, follower, leader
        path = f"{ROOT}:{folder / 'plug'}"
        self.machine = Machine(folder / "state", PYTHONPATH=path, HF_HUB_OFFLINE="1", HF_HOME=str(folder / "hub"))
        self.calibration = write_calibration(folder / "calibration.json")
        (folder / "plug").mkdir()
        (folder / "plug" / "lerobot_camera_moving.py").write_text(CAMERA)
        arm, policies = blocks("toml")
        mine = f'calibration = "{self.calibration}"\ncalibration_dir = "{folder}"\n'
        arm = arm.replace("opencv", "moving").replace("index_or_path = 0\n", "")
        arm = arm.replace("640", str(SIZE)).replace("480", str(SIZE)).replace('id = "left"\n', mine)
        (folder / "arm.toml").write_text(arm)
        (folder / "policies.toml").write_text(policies.replace("[480, 640]", f"[{SIZE}, {SIZE}]"))

    def run(self, line: str, *more: str) -> str:
        """Run a command of the page, and move the leader by hand meanwhile."""
        words = shlex.split(line, comments=True)
        here = [self.leader.port.join(word.split("/dev/ttyACM1")) for word in words[1:]]
        if "--leader-id" in here:
            at = here.index("--leader-id")
            here[at : at + 2] = ["--leader-calibration", str(self.calibration)]
        first = PATIENT if words[0] == "strands-robots" else (str(Path(sys.executable).parent / words[0]),)
        child = subprocess.Popen(
            [*first, *here, *more],
            env=self.machine.environment,
            cwd=self.folder,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        try:
            for place in cycle((*range(1700, 2400, 20), *range(2400, 1700, -20))):
                for servo in range(1, 7):
                    self.leader.set(servo, shaft=float(place))
                try:
                    said, _ = child.communicate(timeout=0.05)
                except subprocess.TimeoutExpired:
                    continue
                assert child.returncode == 0, said
                return said
        finally:
            child.kill()
            child.communicate()
        raise AssertionError("unreachable")

    @contextmanager
    def served(self, line: str) -> Iterator[None]:
        """Serve the arm by a command of the page in the block."""
        here = [self.follower.port.join(word.split("/dev/ttyACM0")) for word in shlex.split(line)[1:]]
        words = [*PATIENT, *here, "--until-stdin-closes"]
        with (self.folder / "served.txt").open("w") as out:
            child = subprocess.Popen(
                words, env=self.machine.environment, cwd=self.folder, stdin=subprocess.PIPE, stdout=out, stderr=out
            )
        try:
            eventually(
                lambda: child.poll() is not None or "arm-1" in self.machine.run("peers").stdout,
                within=100,
                what="the arm on the network",
            )
            assert child.poll() is None, (self.folder / "served.txt").read_text()
            yield
            child.communicate(timeout=100)
            assert child.returncode == 0, (self.folder / "served.txt").read_text()
        finally:
            child.kill()
            child.wait()


@pytest.fixture
def desk(tmp_path: Path) -> Iterator[Desk]:
    with ExitStack() as stack:
        arms = [stack.enter_context(BusProcess(tmp_path / name)) for name in ("ttyACM0", "ttyACM1")]
        yield Desk(tmp_path, *arms)


def lines(block: str) -> Sequence[str]:
    return [line[2:] for line in block.splitlines() if line.startswith("$ ")]


@pytest.mark.timeout(500)
def test_two_arms_become_a_policy_that_is_corrected_by_hand(desk: Desk) -> None:
    (serve,), (record, check, show, train), (serve_again,), (correct,) = map(lines, blocks("console"))
    with desk.served(serve):
        assert "a success" in desk.run(record, *SHORT)
        desk.run(check)
        desk.run(show)
    assert (desk.folder / "my_set.html").stat().st_size > 10_000
    desk.run(train, *TINY)
    with desk.served(serve_again):
        said = desk.run(correct, *SHORT)
        assert "The policy drives." in said
        assert "The leader leads." in said
    info, found = check_dataset(desk.folder / "my_set")
    assert (info.episodes, [each for each in found if each.wrong]) == (4, [])
    alone, turns = (tables.read_frames(desk.folder / "my_set" / data_file(number)) for number in (0, 3))
    assert alone["intervention"].all()
    assert turns["intervention"].any()
    desk.run(train.replace("my_act", "my_act_again"), *TINY)
