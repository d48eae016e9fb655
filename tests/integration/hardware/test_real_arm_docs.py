"""The commands of docs/real-arm.md without an arm, in the environment that the page names (`make real-arm`)."""

from __future__ import annotations

import re
import shlex
import subprocess
from pathlib import Path

import pytest
from fixtures.command_line import Machine
from fixtures.waiting import eventually

pytestmark = pytest.mark.system
PAGE = Path(__file__).parents[3] / "docs" / "real-arm.md"


def test_the_block_without_an_arm_serves_and_moves_the_emulated_one(tmp_path: Path) -> None:
    blocks = re.findall(r"```console\n(.*?)```", PAGE.read_text("utf-8"), re.DOTALL)
    (block,) = (each for each in blocks if "--emulated" in each)
    lines = re.findall(r"^\$ strands-robots (.*)$", block, re.MULTILINE)
    serve, call = (shlex.split(line, comments=True) for line in lines)
    machine = Machine(tmp_path)
    process = machine.start(*serve, "--until-stdin-closes", stdout=subprocess.DEVNULL)
    try:
        eventually(lambda: "arm-1" in machine.run("peers").stdout, within=60, what="the arm on the network")
        moved = machine.run(*call)
        assert moved.returncode == 0, moved.stderr
        assert moved.stdout.startswith("moveJoints completed: it is done.")
        process.communicate(timeout=60)
        assert process.returncode == 0
    finally:
        process.kill()
        process.communicate()


@pytest.mark.parametrize("words", [["so101", "--port", "/dev/ttyACM0"], ["rover"], ["so101", "--mode", "sim"]])
def test_what_cannot_be_emulated_is_refused(tmp_path: Path, words: list[str]) -> None:
    refused = Machine(tmp_path).run("serve", *words, "--emulated")
    assert refused.returncode == 2
    assert "--emulated is for a real so100 or so101 without a serial port" in refused.stderr
