"""Policy profiles: an operator's file, checked as a whole, whose names are what a caller may choose."""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy
import pytest
from fixtures.devices import RecordingDevice
from fixtures.waiting import eventually

from strands_robots import policies
from strands_robots.hardware import HardwareRobot
from strands_robots.policies.base import PolicyError, Ranges
from strands_robots.policies.check import RobotFacts
from strands_robots.policies.preload import PreloadedModels, require_warm
from strands_robots.policies.profiled import ProfiledPolicy, picture
from strands_robots.policies.profiles import CameraMap, Profile, load_profiles
from strands_robots.safety.gate import MotionRefused
from strands_robots.serving.policy_arguments import known_provider, profile_list
from strands_robots.simulation import Simulation
from strands_robots.utils import ValidationError

FILE = """
[pick]
provider = "remote"
url = "ws://localhost:9000"
state = ["lift.pos", "pan.pos", "grip.pos"]
action = ["grip.pos", "pan.pos", "lift.pos"]
units.default = "normalized"
units.grip.pos = "percent"
rate = 25
horizon = 2
task = "pick up the cube"
confirmed = ["units"]
"""


@pytest.fixture
def file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    path = tmp_path / "policies.toml"
    path.write_text(FILE)
    monkeypatch.setenv("STRANDS_POLICIES", str(path))
    return path


def test_a_profile_is_read_with_its_order_and_units(file: Path) -> None:
    pick = load_profiles(file)["pick"]
    assert pick.state == ("lift.pos", "pan.pos", "grip.pos")
    assert pick.action == ("grip.pos", "pan.pos", "lift.pos")
    assert (pick.unit("pan.pos"), pick.unit("grip.pos")) == ("normalized", "percent")
    assert (pick.rate, pick.horizon, pick.task) == (25.0, 2, "pick up the cube")


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('provider = "remote"', "", "profile pick needs provider"),
        ('provider = "remote"', 'provider = "mock"', "provider must be a trained policy"),
        ('url = "ws://localhost:9000"', "", "either checkpoint or url"),
        ('url = "ws://localhost:9000"', 'url = "ws://localhost:9000"\ncheckpoint = "here"', "either checkpoint or url"),
        ('"ws://localhost:9000"', '"http://localhost"', "url must be ws://"),
        ('"ws://localhost:9000"', '"ws://localhost:99999"', "url must be ws://"),
        ('"ws://localhost:9000"', '"ws://me:secret@localhost"', "url must be ws://"),
        ('state = ["lift.pos", "pan.pos", "grip.pos"]', "", "profile pick needs state"),
        ('"lift.pos", "pan.pos", "grip.pos"]', '"pan.pos", "pan.pos"]', "state must name each key once"),
        ('["grip.pos", "pan.pos", "lift.pos"]', "[]", "action must be a list"),
        ('["grip.pos", "pan.pos", "lift.pos"]', '"grip.pos"', "action must be a list"),
        ('"percent"', '"parsec"', "units.grip.pos must be one of"),
        ("rate = 25", "rate = 0", "rate must be"),
        ("rate = 25", "rate = true", "rate must be"),
        ("rate = 25", "rate = nan", "rate must be"),
        ("horizon = 2", "horizon = 0", "horizon must be"),
        ("horizon = 2", "horizon = 9\nchunk = 4", "horizon must be at most chunk"),
        ("horizon = 2", "speed = 2", "has no entry 'speed'"),
        ('["units"]', '["zero"]', "confirmed must be one of"),
        ("rate = 25", "rate = 25\ncameras.front.size = [1, 2]", "cameras.front takes key"),
        ("rate = 25", 'rate = 25\ncameras.front = {key = "a", size = [0, 2]}', r"cameras.front.size\[0\] must be"),
        ("rate = 25", 'rate = 25\ncameras.front = {key = "a", flip = "90"}', "flip must be one of"),
        ("rate = 25", 'rate = 25\ncameras.a.key = "x"\ncameras.b.key = "x"', "must have a key each"),
        ("rate = 25", "rate = ", "cannot be read"),
    ],
)
def test_a_file_with_a_wrong_entry_is_refused_by_name(file: Path, old: str, new: str, words: str) -> None:
    file.write_text(FILE.replace(old, new))
    with pytest.raises(ValidationError, match=words):
        load_profiles(file)


def test_a_file_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValidationError, match="cannot be read"):
        load_profiles(tmp_path / "none.toml")


def test_its_name_is_a_provider_on_every_network_and_in_the_devices_description(file: Path) -> None:
    assert policies.resolve_provider("pick") == "pick"
    assert known_provider("policy_provider", "pick") == "pick"
    assert profile_list() == "; policies: pick"
    with pytest.raises(ValidationError, match="pick"):
        policies.resolve_provider("place")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"policy_host": "10.0.0.1"}, "policy_host must be 'localhost'"),
        ({"policy_port": 9001}, "policy_port must be 9000"),
        ({"pretrained_name_or_path": "lerobot/act"}, "pretrained_name_or_path must be ''"),
        ({"control_frequency": 25.0}, "control_frequency is set by the profile"),
        ({"device": "cuda"}, "device is set by the profile pick alone"),
    ],
)
def test_a_caller_may_repeat_a_profile_and_not_change_it(file: Path, options: dict[str, Any], words: str) -> None:
    pick = load_profiles(file)["pick"]
    with pytest.raises(ValidationError, match=words):
        pick.loop_options(options, 50.0)
    same = {"policy_host": "localhost", "policy_port": 9000, "n_steps": 3, "control_frequency": 50.0}
    assert pick.loop_options(same, 50.0) == {"n_steps": 3, "control_frequency": 50.0}


class Spy:
    """Notes what it sees and answers with chunks."""

    uses_cameras = False

    def __init__(self, *answers: Any) -> None:
        self.answers = list(answers)
        self.seen: list[Mapping[str, Any]] = []
        self.task = ""
        self.ranges: Ranges = {}

    def reset(self, instruction: str, ranges: Ranges) -> None:
        self.task, self.ranges = instruction, ranges

    def act(self, observation: Mapping[str, Any]) -> Any:
        self.seen.append(observation)
        return self.answers.pop(0) if self.answers else None

    def interrupt(self) -> None: ...

    def close(self) -> None: ...


RANGES = {"pan": (-math.pi, math.pi), "lift": (-1.0, 1.0)}
ARM = RobotFacts(
    "arm", {"pan": 0.0, "lift": 0.0}, ["pan", "lift"], dict.fromkeys(("pan", "lift"), "radians"), rate=10.0
)


def profile(**changed: Any) -> Profile:
    entries = {"url": "ws://localhost", "units": {"": "degrees"}, "rate": 10.0, "max_speed": None} | changed
    return Profile("pick", "remote", ("lift", "pan"), ("lift", "pan"), **entries)


def profiled(inner: Any, **changed: Any) -> ProfiledPolicy:
    policy = ProfiledPolicy(profile(**changed), inner)
    policy.compute_inline(lambda: 0.0)
    policy.fit(ARM)
    policy.reset("wave", RANGES)
    return policy


def test_the_policy_sees_the_profiles_keys_in_its_order_and_unit_and_nothing_else() -> None:
    spy = Spy({"pan": 90.0, "lift": 0.0})
    policy = profiled(spy)
    action = policy.act({"battery": 80.0, "pan": math.pi / 2, "lift": 0.5, "flag": True})
    assert list(spy.seen[0].items()) == [("lift", pytest.approx(math.degrees(0.5))), ("pan", pytest.approx(90.0))]
    assert list(spy.ranges) == ["lift", "pan"]
    assert spy.ranges["pan"] == pytest.approx((-180.0, 180.0))
    assert action == {"lift": 0.0, "pan": pytest.approx(math.pi / 2)}


def test_the_task_of_the_profile_outranks_the_instruction() -> None:
    spy = Spy()
    profiled(spy, task="pick up the cube")
    assert spy.task == "pick up the cube"


def played(policy: ProfiledPolicy, steps: int) -> list[dict[str, float]]:
    """The actions of so many control steps; a step without one is an empty action."""
    return [dict(policy.act({"pan": 0.0, "lift": 0.0}) or {}) for _ in range(steps)]


def test_no_more_of_a_chunk_is_played_than_the_horizon() -> None:
    chunks = [[{"pan": float(10 * chunk + step), "lift": 0.0} for step in range(20)] for chunk in range(2)]
    policy = profiled(Spy(*chunks), horizon=3)
    degrees = [math.degrees(action["pan"]) for action in played(policy, 6)]
    assert degrees == pytest.approx([0.0, 1.0, 2.0, 10.0, 11.0, 12.0])


def test_a_jump_at_the_seam_is_bounded_by_the_profiles_speed_and_counted() -> None:
    policy = profiled(Spy([{"pan": 180.0, "lift": 0.0}] * 3), max_speed=0.5)
    # Half of a range of two pi a second, at 10 Hz.
    assert [action["pan"] for action in played(policy, 3)] == pytest.approx([math.pi / 10 * n for n in (1, 2, 3)])
    assert policy.counts()["speed_limited_steps"] == 3


@pytest.mark.parametrize(
    "answer", [{"pan": 1.0}, {"pan": 1.0, "lift": 0.0, "grip": 0.0}, {"pan": math.nan, "lift": 0.0}, [[0.0, 1.0]]]
)
def test_an_answer_with_other_keys_or_no_number_ends_the_task(answer: Any) -> None:
    with pytest.raises(PolicyError):
        profiled(Spy(answer)).act({"pan": 0.0, "lift": 0.0})


def test_a_state_that_the_robot_no_longer_gives_ends_the_task() -> None:
    with pytest.raises(PolicyError, match="no number for lift"):
        profiled(Spy()).act({"pan": 0.0})


def test_a_picture_is_cropped_turned_and_resized() -> None:
    image = numpy.zeros((40, 60, 3), numpy.uint8)
    image[0, 0] = 255
    camera = CameraMap("front", "observation.images.front", size=(20, 20), crop=(0, 0, 20, 20), flip="180")
    turned = picture(camera, image)
    assert turned.shape == (20, 20, 3)
    assert turned.flags["C_CONTIGUOUS"]
    assert turned[19, 19, 0] == 255
    half = picture(CameraMap("front", "k", size=(20, 30)), image)
    assert half.shape == (20, 30, 3)


@pytest.mark.parametrize("shape", [(3, 40, 60), (40, 60, 4), (40, 60)])
def test_what_is_no_rgb_picture_ends_the_task(shape: tuple[int, ...]) -> None:
    with pytest.raises(PolicyError, match="camera front must give"):
        picture(CameraMap("front", "k"), numpy.zeros(shape, numpy.uint8))
    with pytest.raises(PolicyError, match="camera front must give"):
        picture(CameraMap("front", "k"), None)


def test_a_model_is_loaded_once_on_a_thread_and_given_to_one_policy_at_a_time() -> None:
    models, let_go, loads = PreloadedModels(), threading.Event(), list[int]()

    def load() -> object:
        loads.append(1)
        assert let_go.wait(20)
        return object()

    assert models.warm("act", load) == ""
    assert models.warm("act", load) == ""
    let_go.set()
    eventually(lambda: models.warm("act", load) is None, what="the model")
    assert len(loads) == 1
    one, other = models.take("act", load), models.take("act", load)
    assert one is not other
    models.give("act", one)
    assert models.take("act", load) is one


def test_a_policy_that_loads_is_refused_until_it_is_there_and_a_failure_is_told_once() -> None:
    models = PreloadedModels()

    def fail() -> object:
        raise OSError("no weights")

    class Loading:
        def warm(self) -> str | None:
            return models.warm("act", fail)

    with pytest.raises(MotionRefused) as loading:
        require_warm(Loading(), "pick")
    assert loading.value.envelope["loading"] is True
    eventually(lambda: not models._loading)
    with pytest.raises(MotionRefused, match="could not be loaded: OSError: no weights"):
        require_warm(Loading(), "pick")
    with pytest.raises(MotionRefused, match="is loading"):
        require_warm(Loading(), "pick")
    eventually(lambda: not models._loading)


@pytest.fixture
def spies(monkeypatch: pytest.MonkeyPatch) -> list[Spy]:
    """The policies that were made in the place of ``remote``."""
    made: list[Spy] = []

    def make(policy_host: str = "", policy_port: int = 0) -> Spy:
        made.append(Spy({"grip.pos": 90.0, "pan.pos": 0.0, "lift.pos": -50.0}))
        assert (policy_host, policy_port) == ("localhost", 9000)
        return made[-1]

    monkeypatch.setattr(policies, "policy_factory", lambda name: make)
    return made


class UnitDevice(RecordingDevice):
    joint_units = MappingProxyType({"pan.pos": "normalized", "lift.pos": "normalized", "grip.pos": "percent"})


@pytest.fixture
def arm() -> Iterator[HardwareRobot]:
    made = HardwareRobot(UnitDevice(), "arm")
    made.connect()
    yield made
    made.cleanup()


@pytest.mark.usefixtures("file")
def test_a_profile_moves_an_arm_at_its_rate_with_each_value_on_its_own_joint(
    arm: HardwareRobot, spies: list[Spy]
) -> None:
    answer = arm.start_task("anything", policy_provider="pick")
    assert answer["status"] == "success", answer
    eventually(lambda: arm.get_task_status()["task_status"] == "completed")
    # One step at 50 Hz, with the speed bound of the profile: a whole range in a second.
    assert arm.device.writes[0].action == pytest.approx({"pan.pos": 6.0, "lift.pos": 6.0, "grip.pos": 12.0})
    assert list(spies[0].seen[0]) == ["lift.pos", "pan.pos", "grip.pos"]
    assert spies[0].task == "pick up the cube"


@pytest.mark.usefixtures("file")
def test_a_profile_that_does_not_fit_the_arm_is_refused_before_the_first_write(spies: list[Spy]) -> None:
    robot = HardwareRobot(RecordingDevice(), "arm", control_hz=10)
    robot.connect()
    answer = robot.start_task("anything", policy_provider="pick")
    assert answer["status"] == "error"
    assert "the profile pick does not fit this robot" in answer["reason"]
    assert "serve the robot with control_hz=25" in answer["reason"]
    assert robot.device.writes == []
    assert spies[0].seen == []
    robot.cleanup()


@pytest.mark.usefixtures("file", "spies")
def test_a_profile_of_another_robot_is_refused_in_a_simulation_as_well() -> None:
    world = Simulation()
    world.add_robot("so100")
    answer = world.start_policy("so100", "anything", policy_provider="pick")
    assert answer["status"] == "error"
    assert "action has grip.pos" in answer["reason"]
    world.cleanup()
