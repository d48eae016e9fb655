"""The commands of docs/policies.md on an emulated SO-101, in the environment that the page names (`make lerobot`)."""

from __future__ import annotations

import importlib.util
import re
import shlex
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from fixtures.command_line import Machine
from fixtures.feetech_bus import MOTORS, FeetechBus, arm_servos, write_calibration
from fixtures.waiting import eventually

if importlib.util.find_spec("torch") is None or importlib.util.find_spec("lerobot") is None:
    pytest.skip("LeRobot with torch is not installed; `make lerobot` runs this", allow_module_level=True)

from fixtures import lerobot_checkpoints as tiny

ROOT = Path(__file__).parents[3]
PAGE = ROOT / "docs" / "policies.md"
CHECKPOINT = next(
    index
    for index, text in enumerate(re.findall(r"```console\n(.*?)```", PAGE.read_text("utf-8"), re.DOTALL))
    if "make lerobot-next" in text
)
"""Which block of the page is that of a checkpoint of LeRobot's."""

PATIENT = (sys.executable, "-m", "fixtures.feetech_bus.patient", "strands_robots.cli")


def commands(block: int) -> list[list[str]]:
    """Return the words of each `strands-robots` command in a block of the page."""
    text = re.findall(r"```console\n(.*?)```", PAGE.read_text("utf-8"), re.DOTALL)[block]
    lines = re.findall(r"^\$ (?:\S*/)?strands-robots (.*)$", text, re.MULTILINE)
    return [shlex.split(line, comments=True) for line in lines]


@pytest.fixture
def bus(tmp_path: Path) -> Iterator[FeetechBus]:
    with FeetechBus(arm_servos(), link=tmp_path / "ttyACM0") as bus:
        yield bus


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Machine:
    """A machine with the page's file of profiles, beside a checkpoint that was not trained."""
    monkeypatch.chdir(tmp_path)
    toml = re.findall(r"```toml\n(.*?)```", PAGE.read_text("utf-8"), re.DOTALL)[0]
    # The emulated arm has no camera, and the data of the page is not here.
    numbers, _, _ = toml.partition("[pick-cube.cameras.front]")
    numbers = re.sub(r"(?m)^dataset.*$", 'environment = ["wrist_roll.pos", "gripper.pos"]', numbers)
    (tmp_path / "policies.toml").write_text(numbers)
    tiny.act(tmp_path / "outputs" / "act_pick_cube", joints=len(MOTORS))
    return Machine(tmp_path / "state", HF_LEROBOT_HOME=str(tmp_path / "lerobot"), PYTHONPATH=str(ROOT))


def on(bus: FeetechBus, words: list[str], folder: Path) -> list[str]:
    """Return a command's words for the emulated arm, with the calibration that goes with it."""
    calibration = write_calibration(folder / "calibration.json")
    here = [word.replace("/dev/ttyACM0", bus.port) for word in words]
    return [*here, "--set", f"calibration={calibration}", "--set", f"calibration_dir={folder}"]


def run(machine: Machine, *words: str) -> subprocess.CompletedProcess[str]:
    """Run a command whose driver waits for the emulated servos."""
    line = [*PATIENT, *words]
    return subprocess.run(line, env=machine.environment, capture_output=True, text=True, timeout=200, check=False)


@contextmanager
def serving(machine: Machine, *words: str) -> Iterator[Callable[[], str]]:
    """Serve an arm; yield what it has said so far."""
    said = Path("served.txt").resolve()
    with said.open("w") as out:
        line = [*PATIENT, *words, "--until-stdin-closes"]
        process = subprocess.Popen(line, env=machine.environment, stdin=subprocess.PIPE, stdout=out, stderr=out)
    try:
        eventually(
            lambda: "Ctrl-C stops" in said.read_text() or process.poll() is not None, within=100, what="the served arm"
        )
        assert process.poll() is None, said.read_text()
        yield said.read_text
        process.communicate(timeout=100)
        assert process.returncode == 0, said.read_text()
    finally:
        process.kill()
        process.wait()


def test_two_threads_import_a_policy_and_a_driver() -> None:
    program = (
        "import threading\n"
        "from strands_robots.hardware.lerobot_device import lerobot_module\n"
        "from strands_robots.policies.lerobot_local import lerobot_import\n"
        "loader = threading.Thread(target=lerobot_import, args=('lerobot.policies.factory',))\n"
        "loader.start()\n"
        "lerobot_module('lerobot.robots.so_follower')\n"
        "loader.join()\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=200, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""


def test_the_first_commands_of_the_page_check_serve_and_move_an_arm(
    machine: Machine, bus: FeetechBus, tmp_path: Path
) -> None:
    check, serve, grant, call = commands(0)
    assert (check[:2], serve[0], call[0]) == (["policy", "check"], "serve", "call")
    before = bus.shafts()
    checked = run(machine, *on(bus, check, tmp_path))
    assert checked.returncode == 0, checked.stdout + checked.stderr
    assert bus.shafts() == pytest.approx(before, abs=3), "a check moves nothing"
    with serving(machine, *on(bus, serve, tmp_path)) as said:
        assert "Loading the policies pick-cube." in said()
        eventually(lambda: "arm-1" in machine.run("peers").stdout, within=60, what="the arm on the network")

        assert machine.run(*grant).returncode == 0

        def begun() -> bool:
            answer = machine.json(*call)[1]
            assert answer["status"] == "success" or answer.get("loading"), answer
            return answer["status"] == "success"

        eventually(begun, within=100, what="the loaded policy")
        eventually(lambda: bus.shafts() != pytest.approx(before, abs=30), what="a joint that moves")
        assert machine.run("stop", "arm-1").returncode == 0


def test_the_commands_of_a_checkpoint_of_lerobots_serve_an_arm(
    machine: Machine, bus: FeetechBus, tmp_path: Path
) -> None:
    (serve,) = (words for words in commands(CHECKPOINT) if words[0] == "serve")
    with serving(machine, *on(bus, serve, tmp_path)):
        eventually(lambda: "so101" in machine.run("peers").stdout, within=60, what="the arm on the network")
