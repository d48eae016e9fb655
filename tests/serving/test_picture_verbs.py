"""Pictures of simulated worlds and of real cameras, and refusals by name."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import pytest
from PIL import Image

from strands_robots.recording import cameras
from strands_robots.serving.arm_verbs import PICTURE_VERBS
from strands_robots.simulation import Simulation
from strands_robots.utils import ValidationError


@pytest.fixture
def world() -> Iterator[Simulation]:
    simulation = Simulation(realtime=False)
    simulation.add_robot("arm", "so100")
    yield simulation
    simulation.cleanup()


class Filmed:
    """A robot with one camera of 1280 x 720, and one that is unplugged."""

    def camera_frames(self) -> Mapping[str, Any]:
        def gone() -> Any:
            raise ConnectionError("no such device")

        picture = np.zeros((720, 1280, 3), dtype=np.uint8)
        return cameras.LazyFrames({"desk": lambda: picture, "wrist": gone})


def asked(verb: str, robot: Any, **arguments: Any) -> dict[str, Any]:
    described = PICTURE_VERBS[verb]
    assert described.run is not None
    answer: Any = described.run(robot, described.checked(arguments))
    return dict(answer)


def size_of(answer: dict[str, Any]) -> tuple[int, int]:
    image = Image.open(io.BytesIO(base64.b64decode(answer["jpeg"])))
    assert image.format == "JPEG"
    assert image.size == (answer["width"], answer["height"])
    return image.size


def test_cameras_are_listed_with_the_first_one_first(world: Simulation) -> None:
    names = asked("listCameras", world)["cameras"]
    assert names[0] == "front"
    assert {"overview", "front", "table", "arm/wrist"} <= set(names)
    assert asked("listCameras", Filmed())["cameras"] == ["desk", "wrist"]
    assert asked("listCameras", object())["cameras"] == []


def test_picture_of_a_simulation_has_the_size_that_was_asked_for(world: Simulation) -> None:
    answer = asked("getPicture", world)
    assert (answer["camera"], size_of(answer)) == ("front", (640, 480))
    answer = asked("getPicture", world, camera="table", width=64, height=48)
    assert (answer["camera"], size_of(answer)) == ("table", (64, 48))
    assert "jpeg" not in str(answer["content"]).replace("'format': 'jpeg'", "")


def test_picture_of_a_real_camera_is_scaled_down_in_its_own_shape() -> None:
    answer = asked("getPicture", Filmed())
    assert (answer["camera"], size_of(answer)) == ("desk", (640, 360))


def test_pictures_that_cannot_be_taken_are_refused_by_name(world: Simulation, monkeypatch: pytest.MonkeyPatch) -> None:
    assert "camera must be one of front" in asked("getPicture", world, camera="nose")["reason"]
    assert (
        "wrist gave no picture: ConnectionError: no such device"
        in asked("getPicture", Filmed(), camera="wrist")["reason"]
    )
    assert asked("getPicture", object())["reason"] == "this robot has no camera."
    with pytest.raises(ValidationError, match="width must be an integer from 16 to 1920"):
        asked("getPicture", world, width=4000)
    monkeypatch.setattr("strands_robots.serving.arm_verbs.PICTURE_MAX_BYTES", 100)
    assert "ask for a smaller one" in asked("getPicture", world)["reason"]
