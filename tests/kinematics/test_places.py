"""Places outlive the process, in a file that counts only when it is this user's alone."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator

import pytest

from strands_robots.kinematics import PLACES_MAX, load_places, place_file, save_places
from strands_robots.simulation import Simulation
from strands_robots.state_files import state_dir
from strands_robots.utils import ValidationError

Made = Callable[..., Simulation]


@pytest.fixture
def made() -> Iterator[Made]:
    worlds: list[Simulation] = []

    def make(tool_name: str = "cell", *arms: str) -> Simulation:
        world = Simulation(tool_name)
        worlds.append(world)
        for name in arms or ("arm",):
            assert world.add_robot(name, "so100")["status"] == "success"
        return world

    yield make
    for world in worlds:
        world.cleanup()


def test_place_is_gone_to_by_another_process_of_the_same_arm(made: Made) -> None:
    first = made()
    first.move_joints({"shoulder_pan": 20.0}, speed=1.0)
    saved = first.save_place("there")
    assert (saved["places"], saved["kept"]) == (["home", "there"], True)
    first.cleanup()
    assert made().go_to("there", speed=1.0)["task_status"] == "completed"


def test_each_arm_has_places_of_its_own(made: Made) -> None:
    made("cell", "left", "right").save_place("there", robot_name="left")
    again = made("cell", "left", "right")
    assert "place must be one of home, not 'there'" in again.go_to("there", robot_name="right")["reason"]
    assert "place must be one of home, not 'there'" in made("other").go_to("there")["reason"]
    assert again.go_to("there", robot_name="left")["status"] == "success"


@pytest.mark.parametrize(
    "content", ["[]", "{", '{"a b": {}}', '{"there": {"pan": NaN}}', '{"there": {"pan": true}}', "[" * 9999]
)
def test_file_that_holds_no_places_is_refused_by_name(made: Made, content: str) -> None:
    world = made()
    world.save_place("there")
    [file] = (state_dir() / "places").iterdir()
    file.write_text(content)
    answer = made().go_to("there")
    assert answer["status"] == "error"
    assert "saved places of this arm cannot be read" in answer["reason"]


def test_file_that_others_may_write_does_not_count(made: Made) -> None:
    made().save_place("there")
    [file] = (state_dir() / "places").iterdir()
    file.chmod(0o666)
    assert "others may read or write it" in made().go_to("there")["reason"]


def test_directory_that_cannot_be_written_is_told_and_the_place_stays_for_this_process(made: Made) -> None:
    world = made()
    (state_dir() / "places").write_text("no directory")
    saved = world.save_place("there")
    assert saved["status"] == "success"
    assert saved["kept"] is False
    assert "lost with this process" in saved["content"][0]["text"]
    assert world.go_to("there", speed=1.0)["status"] == "success"


def test_home_is_the_models_and_cannot_be_replaced(made: Made) -> None:
    assert "place must not be home" in made().save_place("home")["reason"]


def test_places_of_an_arm_are_bounded() -> None:
    with pytest.raises(ValidationError, match=str(PLACES_MAX)):
        save_places("arm", {f"p{n}": {"pan": 1.0} for n in range(PLACES_MAX + 1)})
    save_places("arm", {"a": {"pan": 1.0}})
    assert json.loads(place_file("arm").read_text()) == {"a": {"pan": 1.0}}
    assert load_places("arm") == {"a": {"pan": 1.0}}
    assert place_file("arm").stat().st_mode & 0o777 == 0o600
