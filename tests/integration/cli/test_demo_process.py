"""The demo as a new user runs it, and the demo with one fault."""

from __future__ import annotations

import json
import math
import signal
import subprocess
from contextlib import suppress
from pathlib import Path

import psutil
import pytest
from fixtures.command_line import COMMAND, Machine
from fixtures.waiting import eventually

WITHIN_S = 200.0
pytestmark = pytest.mark.timeout(600)


def start(folder: Path, *arguments: str, **more: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [*COMMAND, "demo", *arguments],
        cwd=folder,
        env={**Machine(folder / "state").environment, **more},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def served_by(run: subprocess.Popen[str]) -> psutil.Process | None:
    """Return the process in which the demo serves its robot."""
    for child in psutil.Process(run.pid).children():
        with suppress(psutil.NoSuchProcess):  # a child of another kind that has just ended
            if "serve" in child.cmdline():
                return child
    return None


def gone(process: psutil.Process) -> bool:
    return not process.is_running() or process.status() == psutil.STATUS_ZOMBIE


def test_demo_runs_every_step_and_writes_its_pictures(tmp_path: Path) -> None:
    # A network of the user's own must not get in its way.
    run = start(tmp_path, "--record", "demo.svg", "--json", NATS_URL="nats://192.0.2.1:4222", TENANT="elsewhere")
    output, complaints = run.communicate(timeout=WITHIN_S)
    assert run.returncode == 0, complaints
    report = json.loads(output)
    assert report["status"] == "success"
    steps = {step["step"]: step for step in report["steps"]}
    safety = ["emergency stop", "refusal", "resume", "place"]
    assert list(steps) == ["serve", "discover", "look", "stop", "pick", *safety, "leave", "pictures"]
    assert all(step["ok"] for step in steps.values())
    assert {"execute", "stop", "getStatus", "getFeatures"} <= set(steps["discover"]["functions"])
    assert steps["pick"]["holding"] is True
    assert steps["stop"]["drift_rad"] <= 0.005
    assert steps["emergency stop"]["estop_id"] in steps["refusal"]["reason"]
    assert steps["place"]["still_held"] is True
    # The cube is 25 mm wide and the plate 100 mm, and the simulation is asked where they are.
    cube, plate = (steps["place"]["objects"][name] for name in ("red_cube", "plate"))
    assert math.hypot(cube["x"] - plate["x"], cube["y"] - plate["y"]) < 0.033
    assert cube["z"] - plate["z"] == pytest.approx(0.0125 + 0.004, abs=0.004)
    assert steps["look"]["objects"]["red_cube"]["y"] > 0.05
    assert steps["look"]["picture"].items() >= {"width": 640, "height": 480, "file": "demo-output/table.jpg"}.items()
    assert (tmp_path / "demo-output" / "table.jpg").read_bytes().startswith(b"\xff\xd8")
    assert not (tmp_path / "state").exists(), "the demo's lockout and audit are its own"
    assert (tmp_path / "demo-output" / "arm-path.png").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "demo-output" / "demo.gif").read_bytes().startswith(b"GIF89a")
    assert all(Path(tmp_path / file).stat().st_size < 1_000_000 for file in report["files"])
    assert "url(http" not in (tmp_path / "demo.svg").read_text(encoding="utf-8")


def test_refused_motion_fails_the_demo(tmp_path: Path) -> None:
    run = start(tmp_path, DEVICE_CONNECT_RPC_ALLOW="other-caller")
    output, complaints = run.communicate(timeout=WITHIN_S)
    assert run.returncode == 1
    assert "pick was refused" in complaints
    assert "What the agent can call" in output
    assert [file.name for file in (tmp_path / "demo-output").iterdir()] == ["table.jpg"], "nothing moved to draw"


def test_dead_robot_process_fails_the_demo(tmp_path: Path) -> None:
    run = start(tmp_path, "--json")
    served = eventually(lambda: served_by(run), within=60.0, what="the demo's robot process")
    served.kill()
    output, _ = run.communicate(timeout=WITHIN_S)
    assert run.returncode == 1
    assert json.loads(output)["status"] == "error"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_interrupted_demo_ends_its_robot_process(tmp_path: Path, number: signal.Signals) -> None:
    run = start(tmp_path)
    served = eventually(lambda: served_by(run), within=60.0, what="the demo's robot process")
    run.send_signal(number)
    run.communicate(timeout=WITHIN_S)
    eventually(lambda: gone(served), what="the demo's robot process is gone")
    assert run.returncode == (-9 if number == signal.SIGKILL else 130)
