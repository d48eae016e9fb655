"""A robot of another package, whose protocol is not ours: installed beside ours into an empty environment, and used."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from fixtures.command_line import Machine
from fixtures.empty_environment import ROOT, build, empty_environment
from fixtures.waiting import eventually

EXAMPLE = ROOT / "examples" / "third_party_robot"
WITHIN_S = 60.0
pytestmark = [pytest.mark.system, pytest.mark.timeout(300)]


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of commands of an environment that holds our wheel and that of the rail."""
    folder = tmp_path_factory.mktemp("dist")
    for project in (ROOT, EXAMPLE):
        build(project, folder, "--target", "wheel")
    return empty_environment(tmp_path_factory.mktemp("empty"), *folder.glob("*.whl"))


class Rail:
    """The emulator of the rail as a process, which prints each frame and each change of its motion."""

    def __init__(self, installed: Path) -> None:
        command = [installed / "tarn-rail-emulator", "--port", "0"]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        self.port = int(self.seen("listening").split()[1])

    def seen(self, start: str) -> str:
        """Return the next line that begins so; those before it are skipped."""
        assert self.process.stdout is not None
        for line in self.process.stdout:
            if line.startswith(start):
                return line.strip()
        raise AssertionError(f"the emulator has ended, and never said {start}")


class Installed:
    """Commands of the environment, on a machine of their own."""

    def __init__(self, installed: Path, state: Path) -> None:
        self.path = installed / "strands-robots"
        approved = {"DEVICE_CONNECT_RPC_ALLOW": "strands-robots", "STRANDS_ROBOT_COMMAND_ALLOW": "slideTo,shuttle"}
        self.environment = Machine(state, **approved).environment
        # Nothing of this checkout.
        self.environment.pop("PYTHONPATH", None)
        self.state = state

    def start(self, *words: str) -> subprocess.Popen[str]:
        self.state.mkdir(exist_ok=True)
        return subprocess.Popen(
            [self.path, *words], cwd=self.state, env=self.environment, stdout=subprocess.PIPE, text=True
        )

    def last_json(self, *words: str) -> tuple[int, dict[str, Any]]:
        command = self.start(*words, "--json")
        try:
            out = command.communicate(timeout=WITHIN_S)[0]
        finally:
            command.kill()
            command.wait()
        last: dict[str, Any] = json.loads(out.splitlines()[-1])
        return command.returncode, last


@contextmanager
def ended(process: subprocess.Popen[str]) -> Iterator[None]:
    try:
        yield
    finally:
        process.terminate()
        process.communicate(timeout=WITHIN_S)


@pytest.fixture
def commands(installed: Path, tmp_path: Path) -> Installed:
    return Installed(installed, tmp_path / "state")


def test_its_own_tests_pass_as_written() -> None:
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "tests/test_rail.py"]
    ran = subprocess.run(command, cwd=EXAMPLE, capture_output=True, text=True, timeout=2 * WITHIN_S, check=False)
    assert ran.returncode == 0, ran.stdout + ran.stderr


def test_doctor_finds_it_by_its_entry_point(commands: Installed) -> None:
    command = commands.start("doctor")
    out = command.communicate(timeout=WITHIN_S)[0]
    (line,) = (each for each in out.splitlines() if "tarn_rail" in each)
    assert "tarn-rail 1.0.0" in line


def test_it_is_gold_where_it_is_installed(commands: Installed) -> None:
    code, report = commands.last_json("conform", "tarn_rail.conformance:subject", "--tier", "gold")
    assert (code, report["tier"], report["failed"]) == (0, "gold", 0), report


def test_it_is_served_moved_stopped_and_locked(commands: Installed, installed: Path) -> None:
    rail = Rail(installed)
    serve = ("serve", "tarn_rail", "--peer-id", "rail-1", "--set", f"port={rail.port}", "--json")
    with ended(rail.process), ended(served := commands.start(*serve)):
        assert served.stdout is not None
        assert json.loads(served.stdout.readline())["event"] == "serving"
        code, answer = commands.last_json("call", "rail-1", "slideTo", "position_mm=20")
        assert (code, answer["task_status"], answer["position_mm"]) == (0, "completed", 20.0), answer
        assert rail.seen("IDLE at") == "IDLE at 20.0"

        with ended(commands.start("call", "rail-1", "shuttle", "trips=50")):
            rail.seen("MOVING to 1200.0")
            code, stopped = commands.last_json("stop", "rail-1")
            assert code == 0, stopped
            rail.seen("STOP")
            rail.seen("HELD at")

        with ended(commands.start("call", "rail-1", "shuttle", "trips=50")):
            rail.seen("MOVING to 1200.0")
            code, pressed = commands.last_json("estop")
            assert code == 0, pressed
            rail.seen("HELD at")

        def locked() -> bool:
            code, refused = commands.last_json("call", "rail-1", "slideTo", "position_mm=30")
            return code == 1 and "locked by the emergency stop" in refused["reason"]

        eventually(locked, what="the refusal of a locked rail")
        _, read = commands.last_json("call", "rail-1", "readState")
        assert read["rail"] == "HELD"
