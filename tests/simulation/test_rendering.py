"""Pictures with and without OpenGL, paths and animations."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from strands_robots.simulation import Simulation, engine
from strands_robots.simulation.rendering import Recording, RenderingError, draw_path, save_animation
from strands_robots.utils import ValidationError

OPENGL = any(engine.loads(backend) for backend in ("egl", "osmesa"))
needs_opengl = pytest.mark.skipif(not OPENGL, reason=f"no OpenGL here: needs {engine.PACKAGES}")


@pytest.fixture
def world() -> Iterator[Simulation]:
    simulation = Simulation(realtime=False)
    simulation.add_robot("arm", "so100")
    yield simulation
    simulation.cleanup()


def orange(picture: np.ndarray) -> float:
    """Share of the picture that has the arm's colour."""
    r, g, b = (picture[..., i].astype(int) for i in range(3))
    return float(((r > 120) & (r - b > 70) & (r - g > 40)).mean())


@pytest.mark.parametrize("camera", ["overview", "front", "side"])
def test_projection_shows_the_arm(world: Simulation, camera: str) -> None:
    picture = world.project(camera, 160, 120)
    assert picture.shape == (120, 160, 3)
    assert picture.dtype == np.uint8
    assert orange(picture) > 0.01


def test_projection_follows_the_arm(world: Simulation) -> None:
    before = world.project("top", 160, 120)
    world.send_action({"shoulder_pan": 1.2})
    world.step(500)
    assert np.abs(before.astype(int) - world.project("top", 160, 120)).mean() > 1.0


def test_path_is_drawn_from_blue_to_red() -> None:
    blank = np.full((60, 80, 3), 255, dtype=np.uint8)
    drawn = draw_path(blank, np.array([[5.0, 30.0], [40.0, 30.0], [75.0, 30.0]]))
    assert drawn[30, 12, 2] > drawn[30, 12, 0]
    assert drawn[30, 70, 0] > drawn[30, 70, 2]
    assert (blank == 255).all()


def test_gripper_tip_is_within_the_overview(world: Simulation) -> None:
    x, y, depth = world.view("overview").pixels([world.tip_position("arm")], 320, 240)[0]
    assert 0 < x < 320
    assert 0 < y < 240
    assert depth > 0


def test_recording_is_saved_as_picture_and_animation(world: Simulation, tmp_path: Path) -> None:
    recording = Recording(world, width=96, height=72)
    for target in (0.2, 0.5, 0.8):
        world.send_action({"shoulder_pan": target})
        world.step(60)
        recording.capture()
    gif = Image.open(recording.save_animation(tmp_path / "out" / "arm.gif", fps=10))
    assert (gif.size, getattr(gif, "n_frames", 1)) == ((96, 72), 3)
    assert Image.open(recording.save_picture(tmp_path / "arm.png", 128, 96)).size == (128, 96)
    assert recording.how in ("opengl", "projection")


@pytest.mark.parametrize("fps", [0, 51, float("nan")])
def test_animation_without_frames_or_with_a_bad_rate_is_refused(tmp_path: Path, fps: float) -> None:
    with pytest.raises(ValidationError, match="frames"):
        save_animation([], tmp_path / "a.gif")
    with pytest.raises(ValidationError, match="fps"):
        save_animation([np.zeros((8, 8, 3), dtype=np.uint8)], tmp_path / "a.gif", fps)


@pytest.mark.parametrize(("width", "height"), [(15, 64), (64, 5000), (True, 64), (64.0, 64)])
def test_bad_picture_size_is_refused(world: Simulation, width: int, height: int) -> None:
    with pytest.raises(ValidationError, match=r"width|height"):
        world.project("overview", width, height)
    with pytest.raises(ValidationError, match=r"width|height"):
        world.render("overview", width, height)


def test_unknown_camera_is_refused_with_the_known_ones(world: Simulation) -> None:
    with pytest.raises(ValidationError, match="overview, front, side, top, table, arm/wrist"):
        world.project("nose")


def test_short_camera_name_works_while_it_is_unique(world: Simulation) -> None:
    assert world.view("wrist").camera == "arm/wrist"
    world.add_robot("other", "so100")
    with pytest.raises(ValidationError, match="other/wrist"):
        world.view("wrist")


@pytest.mark.system
@needs_opengl
@pytest.mark.parametrize("camera", ["overview", "front", "side", "top", "wrist"])
def test_opengl_shows_the_arm_without_a_display(world: Simulation, camera: str) -> None:
    picture = world.render(camera, 160, 120)
    assert picture.shape == (120, 160, 3)
    assert orange(picture) > 0.005


@pytest.mark.system
@needs_opengl
def test_opengl_and_projection_show_the_arm_at_the_same_place(world: Simulation) -> None:
    drawn, projected = world.render("side", 160, 120), world.project("side", 160, 120)
    assert orange(drawn) == pytest.approx(orange(projected), rel=0.35)


@pytest.mark.system
@needs_opengl
def test_pictures_can_be_drawn_from_any_thread_and_cleanup_ends_the_rendering_thread(world: Simulation) -> None:
    pictures: list[np.ndarray] = []
    threads = [threading.Thread(target=lambda: pictures.append(world.render("front", 64, 48))) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert all(np.array_equal(pictures[0], p) for p in pictures)
    world.cleanup()
    assert not [t for t in threading.enumerate() if t.name.startswith("simulation-render")]


@pytest.mark.system
@needs_opengl
def test_picture_shows_a_robot_that_was_added_later(world: Simulation) -> None:
    first = world.render("overview", 64, 48)
    world.add_robot("car", "rover", position=(0.3, 0.2, 0))
    assert not np.array_equal(first, world.render("overview", 64, 48))


def test_missing_opengl_is_reported_and_picture_still_works(world: Simulation, monkeypatch: pytest.MonkeyPatch) -> None:
    def none(*_: object, **__: object) -> None:
        raise ImportError("libEGL.so.1 is not there")

    monkeypatch.setattr("mujoco.Renderer", none)
    with pytest.raises(RenderingError, match=r"libegl1 .*libosmesa6"):
        world.render("overview", 64, 48)
    picture, how = world.picture("overview", 64, 48)
    assert how == "projection"
    assert picture.shape == (48, 64, 3)


@pytest.mark.parametrize(
    ("libraries", "chosen"), [(("egl", "osmesa"), "egl"), (("osmesa",), "osmesa"), ((), "disable")]
)
def test_available_backend_is_chosen_without_a_display(
    monkeypatch: pytest.MonkeyPatch, libraries: tuple[str, ...], chosen: str
) -> None:
    monkeypatch.setenv("MUJOCO_GL", "")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.setattr(engine, "loads", lambda backend: backend in libraries)
    monkeypatch.setattr("platform.system", lambda: "Linux")
    engine.prepare.cache_clear()
    try:
        assert engine.prepare() == chosen
    finally:
        engine.prepare.cache_clear()


@pytest.mark.parametrize(("display", "chosen"), [("", "osmesa"), (":0", "glfw")])
def test_windowed_backend_is_taken_only_where_there_is_a_display(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, display: str, chosen: str
) -> None:
    monkeypatch.setenv("MUJOCO_GL", "glfw")
    monkeypatch.setenv("DISPLAY", display)
    monkeypatch.setattr(engine, "loads", lambda backend: backend == "osmesa")
    engine.prepare.cache_clear()
    try:
        assert engine.prepare() == chosen
        assert ("needs a display" in caplog.text) is (not display)
    finally:
        engine.prepare.cache_clear()


@pytest.mark.parametrize("configured", ["egl", "osmesa", "glfw"])
def test_configured_backend_that_cannot_load_is_disabled(monkeypatch: pytest.MonkeyPatch, configured: str) -> None:
    monkeypatch.setenv("MUJOCO_GL", configured)
    monkeypatch.setattr(engine, "loads", lambda backend: False)
    engine.prepare.cache_clear()
    try:
        assert engine.prepare() == "disable"
    finally:
        engine.prepare.cache_clear()


def test_world_without_opengl_steps_and_projects() -> None:
    code = (
        "from strands_robots.simulation import Simulation\n"
        "s = Simulation(); s.add_robot('so100'); s.step(10); print(s.picture('overview', 64, 48)[1])"
    )
    ran = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "MUJOCO_GL": "disable"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert ran.stdout == "projection\n"
