"""Let a Reachy Mini in MuJoCo wake up and nod under our driver, and draw what its joints did.

    ./scripts/reachy-daemon.sh 1.13.0
    .venv/bin/python -m examples.reachy_nod docs/images/reachy-mini-nod.png

The daemon is Pollen's own in its MuJoCo simulation; the picture is Pollen's model, posed by the joint positions that
the daemon streamed to our driver. Needs OpenGL (EGL or OSMesa) to draw.
"""

from __future__ import annotations

import argparse
import os
import time
from pathlib import Path

from fixtures.reachy_daemon.process import Daemon, Kind
from fixtures.waiting import eventually

from strands_robots.drivers.reachy import ReachyDriver
from strands_robots.drivers.reachy.connection import JointSample
from strands_robots.drivers.reachy.target import HeadPose, Target

SIZE = (400, 480)
Sample = tuple[JointSample, float]
"""Joints, and the head's pitch in radians."""


def record(daemon: Daemon) -> list[Sample]:
    """Record the joints at 50 Hz from upright through a nod and a happy wiggle."""
    reachy = ReachyDriver("127.0.0.1", api_port=daemon.port)
    reachy.connect()
    try:
        print(reachy.wake_up()["content"][0]["text"])
        eventually(lambda: reachy.facts()["moving"] == "", 15.0, "awake")
        reachy.go(Target(HeadPose(), 0.0, (-0.1745, 0.1745)))
        time.sleep(1.0)
        samples: list[Sample] = []
        for gesture in ("nod", "happy"):
            print(reachy.gesture(gesture)["content"][0]["text"])
            while reachy.facts()["moving"]:
                joints, pose = reachy.connection.feed.joints, reachy.connection.feed.pose()
                if joints is not None and pose is not None and (not samples or joints.at > samples[-1][0].at):
                    samples.append((joints, pose.pitch))
                time.sleep(0.01)
        return samples
    finally:
        reachy.disconnect()


def draw(model_path: Path, samples: list[Sample], picture: Path) -> None:
    """Draw a strip of stills, and the whole motion as an animation."""
    # MuJoCo reads this while it is imported.
    os.environ.setdefault("MUJOCO_GL", "egl")
    import mujoco  # noqa: PLC0415 - after the choice above
    from PIL import Image  # noqa: PLC0415 - only to draw

    model = mujoco.MjModel.from_xml_path(str(model_path))
    model.vis.global_.offheight = model.vis.global_.offwidth = max(SIZE)
    data = mujoco.MjData(model)
    camera = mujoco.MjvCamera()
    camera.lookat[:], camera.distance, camera.azimuth, camera.elevation = (0, 0, 0.19), 0.62, 225, -12
    images: list[Image.Image] = []
    started = samples[0][0].at
    with mujoco.Renderer(model, SIZE[1], SIZE[0]) as renderer:
        for joints, _ in samples:
            # The daemon's MuJoCo counts the antennas the other way round.
            data.ctrl[:] = [*joints.head, *(-angle for angle in joints.antennas)]
            while data.time < 1.0 + joints.at - started:
                mujoco.mj_step(model, data)
            renderer.update_scene(data, camera)
            images.append(Image.fromarray(renderer.render()))
    pitches, antennas = [pitch for _, pitch in samples], [joints.antennas[0] for joints, _ in samples]
    stills = [pitches.index(max(pitches)), pitches.index(min(pitches))]
    stills = [0, *stills, antennas.index(max(antennas)), antennas.index(min(antennas))]
    strip = Image.new("RGB", (SIZE[0] * len(stills), SIZE[1]))
    for column, index in enumerate(stills):
        strip.paste(images[index], (column * SIZE[0], 0))
    picture.parent.mkdir(parents=True, exist_ok=True)
    strip.save(picture, optimize=True)
    small = [image.resize((SIZE[0] // 2, SIZE[1] // 2)).quantize(64) for image in images[::3]]
    small[0].save(picture.with_suffix(".gif"), save_all=True, append_images=small[1:], duration=60, loop=0)
    print(f"{picture} and {picture.with_suffix('.gif')} have {len(images)} samples.")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("picture", type=Path)
    options = parser.parse_args()
    kind = Kind("1.13.0", "mujoco")
    if why := kind.missing():
        parser.error(why)
    with Daemon(kind) as daemon:
        samples = record(daemon)
    scene = next(kind.venv.glob("lib/*/site-packages/reachy_mini/descriptions/reachy_mini/mjcf/scenes/empty.xml"))
    draw(scene, samples, options.picture)


if __name__ == "__main__":
    main()
