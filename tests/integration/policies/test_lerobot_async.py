"""The client of LeRobot's async server against that server, and against a stand-in that makes it fail in every way.

LeRobot's own is started where LeRobot is installed, which is what `make lerobot` makes.
"""

from __future__ import annotations

import importlib.util
import json
import os
import pickle
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol

import numpy
import pytest
from fixtures.devices import RANGES, RecordingDevice
from fixtures.lerobot_pickles import LongStorage, StorageBytes, Tensor, TimedAction, answered, wired
from fixtures.waiting import eventually, free_port

from strands_robots.hardware import HardwareRobot
from strands_robots.policies import create_policy
from strands_robots.policies.lerobot_async import LeRobotAsyncConnection, LeRobotAsyncPolicy, _pieces, pickled
from strands_robots.policies.policy_server import PolicyServerError
from strands_robots.policies.profiles import CameraMap, Profile, load_profiles
from strands_robots.utils import ValidationError

if importlib.util.find_spec("grpc") is None:
    pytest.skip("gRPC is not installed; `make lerobot` runs this", allow_module_level=True)

from fixtures.lerobot_async_server import LeRobotAsyncServer

# LeRobot's server is a minute until it answers where the machine is busy.
pytestmark = pytest.mark.timeout(600)

JOINTS = ("pan.pos", "lift.pos", "grip.pos")
SEEN = {"pan.pos": 1.0, "lift.pos": 2.0, "grip.pos": 3.0}
KEY = "observation.images.front"
FRONT = (CameraMap("webcam", KEY, size=(96, 128)),)
PICTURE = numpy.random.default_rng(1).integers(0, 255, (96, 128, 3), numpy.uint8)
CHUNK = 10

needs_lerobot = pytest.mark.skipif(
    importlib.util.find_spec("lerobot") is None or importlib.util.find_spec("torch") is None,
    reason="LeRobot with torch is not installed; `make lerobot` runs this",
)


def rows(steps: int = CHUNK, first: float = 0.0) -> list[list[float]]:
    return [[first + step, 1.0, 2.0] for step in range(steps)]


def profile(url: str, **changed: Any) -> Profile:
    entries = {"checkpoint": "checkpoints/act", "policy_type": "act", "first_deadline_s": 240.0, "deadline_s": 20.0}
    return Profile("async", "lerobot_async", JOINTS, JOINTS, url=url, **{**entries, **changed})


class Site(Protocol):
    """A server, and what a profile of it has to say."""

    url: str
    entries: dict[str, Any]


class StandIn(LeRobotAsyncServer):
    """Answers ten actions whatever it sees."""

    def __init__(self) -> None:
        super().__init__(lambda observation: rows())
        self.entries: dict[str, Any] = {"cameras": FRONT}


class OwnServer:
    """LeRobot's policy server in a process of its own, and a tiny ACT."""

    def __init__(self, folder: Path) -> None:
        tiny = import_module("fixtures.lerobot_checkpoints")
        self.checkpoint = tiny.act(folder / "act", images={KEY: (96, 128)})
        self.entries: dict[str, Any] = {"cameras": FRONT, "checkpoint": str(self.checkpoint)}
        self.port = free_port()
        self.url = f"grpc://127.0.0.1:{self.port}"
        command = [sys.executable, "-m", "lerobot.async_inference.policy_server"]
        # It writes its log into a folder of the directory in which it is started.
        self.log = folder / "server.log"
        with self.log.open("w") as log:
            self._process = subprocess.Popen(
                [*command, "--host=127.0.0.1", f"--port={self.port}"],
                cwd=folder,
                stdout=log,
                stderr=log,
                env={**os.environ, "HF_HUB_OFFLINE": "1"},
            )

    def stop(self) -> None:
        """End it."""
        self._process.kill()
        self._process.wait(20)


@pytest.fixture(scope="module")
def own_server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[OwnServer]:
    server = OwnServer(tmp_path_factory.mktemp("lerobot"))
    try:
        yield server
    finally:
        server.stop()


@pytest.fixture(params=["stand-in", pytest.param("lerobot", marks=needs_lerobot)])
def site(request: pytest.FixtureRequest) -> Iterator[Site]:
    """Each of the servers; LeRobot's is waited for."""
    if request.param == "lerobot":
        yield request.getfixturevalue("own_server")
    else:
        with StandIn() as stand_in:
            yield stand_in


@pytest.fixture
def made() -> Iterator[Callable[..., LeRobotAsyncPolicy]]:
    """Makes a policy that was reset, once its server answers."""
    with ExitStack() as stack:

        def make(url: str, **changed: Any) -> LeRobotAsyncPolicy:
            policy = LeRobotAsyncPolicy(profile(url, **changed))
            stack.callback(_forget, policy)
            eventually(lambda: _reset(policy), within=240.0, what="a server that answers")
            return policy

        yield make


def _reset(policy: LeRobotAsyncPolicy) -> bool:
    try:
        policy.reset("pick up the cube", RANGES)
    except PolicyServerError as exc:
        if "no policy server answers" not in str(exc):
            raise
        return False
    return True


def _forget(policy: LeRobotAsyncPolicy) -> None:
    """Close a policy, and the connection that it leaves to the next one."""
    policy.close()
    connection = LeRobotAsyncPolicy.connections.take(policy._key, lambda: None)
    if connection is not None:
        connection.close()


class TestEveryServer:
    """The contract of the wire, on LeRobot's server and on the stand-in."""

    def test_an_observation_is_answered_by_a_chunk_of_the_profiles_keys(self, site: Site, made: Any) -> None:
        policy = made(site.url, chunk=CHUNK, **site.entries)
        for _ in range(3):
            actions = policy.act({**SEEN, "front": PICTURE})
            assert len(actions) == CHUNK
            assert all(list(each) == list(JOINTS) for each in actions)

    def test_an_observation_of_many_pieces_is_answered(self, site: Site, made: Any) -> None:
        large = numpy.zeros((1080, 1920, 3), numpy.uint8)
        policy = made(site.url, **{**site.entries, "cameras": (CameraMap("webcam", KEY, size=(1080, 1920)),)})
        assert len(policy.act({**SEEN, "front": large})) == CHUNK

    def test_a_chunk_of_another_length_than_the_profiles_is_refused(self, site: Site, made: Any) -> None:
        with pytest.raises(PolicyServerError, match=f"chunk is {CHUNK}, and the profile has 50"):
            made(site.url, chunk=50, **site.entries)

    def test_actions_that_the_profile_does_not_name_are_refused(self, site: Site) -> None:
        made_of = Profile("other", "lerobot_async", JOINTS, JOINTS[:2], url=site.url, **_of(site))
        policy = LeRobotAsyncPolicy(made_of)
        with pytest.raises(PolicyServerError, match=r"shape \(10, 3\), and the profile has 2 keys"):
            eventually(lambda: _reset(policy), within=240.0)

    def test_a_stop_leaves_the_server_ready_for_the_next_task(self, site: Site, made: Any) -> None:
        policy = made(site.url, **site.entries)
        policy.interrupt()
        with pytest.raises(PolicyServerError, match="the task was stopped"):
            policy.act({**SEEN, "front": PICTURE})
        policy.close()
        again = LeRobotAsyncPolicy(policy.profile)
        assert again.warm() is None
        again.reset("once more", RANGES)
        assert len(again.act({**SEEN, "front": PICTURE})) == CHUNK
        again.close()

    def test_a_second_robot_is_refused_while_one_is_served(self, site: Site, made: Any) -> None:
        policy = made(site.url, **site.entries)
        second = LeRobotAsyncPolicy(Profile("second", "lerobot_async", JOINTS, JOINTS, url=site.url, **_of(site)))
        with pytest.raises(PolicyServerError, match="in use by the profile async; it serves one robot at a time"):
            second.reset("wave", RANGES)
        assert len(policy.act({**SEEN, "front": PICTURE})) == CHUNK


def _of(site: Site) -> dict[str, Any]:
    return {"checkpoint": "checkpoints/act", "policy_type": "act", "first_deadline_s": 240.0, **site.entries}


@needs_lerobot
class TestLeRobotsServer:
    """What only LeRobot's own can show."""

    def test_the_actions_are_those_that_lerobot_computes(self, own_server: OwnServer, made: Any) -> None:
        torch, factory = import_module("torch"), import_module("lerobot.policies.factory")
        configs, utils = import_module("lerobot.configs.policies"), import_module("lerobot.policies.utils")
        policy = made(own_server.url, **own_server.entries)
        given = [list(each.values()) for each in policy.act({**SEEN, "front": PICTURE})]
        directory = str(own_server.checkpoint)
        config = configs.PreTrainedConfig.from_pretrained(directory)
        model = factory.get_policy_class(config.type).from_pretrained(directory, config=config)
        before, after = factory.make_pre_post_processors(config, pretrained_path=directory)
        frame = {"observation.state": numpy.array(list(SEEN.values()), numpy.float32), KEY: PICTURE}
        with torch.inference_mode():
            batch = before(utils.prepare_observation_for_inference(frame, torch.device("cpu"), "", ""))
            expected = after(model.predict_action_chunk(batch))[0].numpy()
        assert numpy.array(given) == pytest.approx(expected, abs=1e-3)

    def test_a_checkpoint_that_it_cannot_load_is_named(self, own_server: OwnServer, made: Any, tmp_path: Path) -> None:
        made(own_server.url, **own_server.entries).close()
        _forget(LeRobotAsyncPolicy(profile(own_server.url)))
        with pytest.raises(PolicyServerError, match="failed in SendPolicyInstructions"):
            made(own_server.url, **{**own_server.entries, "checkpoint": str(tmp_path)})
        with pytest.raises(PolicyServerError, match="failed in SendPolicyInstructions"):
            made(own_server.url, **{**own_server.entries, "policy_type": "resnet"})

    def test_an_inference_that_fails_there_is_told_before_a_motion(self, own_server: OwnServer, made: Any) -> None:
        misnamed = (CameraMap("webcam", "observation.images.side", size=(96, 128)),)
        with pytest.raises(PolicyServerError, match="answered no actions; why is in its own log alone"):
            made(own_server.url, **{**own_server.entries, "cameras": misnamed})

    def test_the_stand_in_answers_what_lerobot_reads(self) -> None:
        found = pickle.loads(answered([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]], 10.0, 7))
        assert [(each.get_timestep(), each.get_action().tolist()) for each in found] == [
            (7, [1.0, 2.0, 3.0]),
            (8, [4.0, 5.0, 6.0]),
        ]


@pytest.fixture
def stand_in() -> Iterator[LeRobotAsyncServer]:
    with LeRobotAsyncServer(lambda observation: rows()) as server:
        yield server


def test_the_server_is_told_what_to_load_and_how_to_read_observations(stand_in: Any, made: Any) -> None:
    made(stand_in.url, cameras=FRONT, horizon=8, device="cuda:0")
    assert stand_in.called == ["Ready", "SendPolicyInstructions"]
    (told,) = stand_in.instructions
    assert type(told).__name__ == "RemotePolicyConfig"
    assert vars(told) == {
        "policy_type": "act",
        "pretrained_name_or_path": "checkpoints/act",
        "actions_per_chunk": 8,
        "device": "cuda:0",
        "rename_map": {},
        "lerobot_features": {
            "observation.state": {"dtype": "float32", "shape": (3,), "names": list(JOINTS)},
            KEY: {"dtype": "image", "shape": (96, 128, 3), "names": ["height", "width", "channels"]},
        },
    }


def test_an_observation_has_joints_pictures_and_the_task(stand_in: Any, made: Any) -> None:
    policy = made(stand_in.url, cameras=FRONT)
    policy.act({**SEEN, "front": PICTURE})
    seen = stand_in.seen[-1]
    assert (seen["front"] == PICTURE).all()
    assert {key: seen[key] for key in seen if key != "front"} == {**SEEN, "task": "pick up the cube"}
    assert len(stand_in.seen) == 2, "the first inference has a blank picture"


def test_a_long_observation_goes_in_pieces_of_two_megabytes(stand_in: Any, made: Any) -> None:
    policy = made(stand_in.url, cameras=(CameraMap("webcam", KEY, size=(1080, 1920)),))
    stand_in.pieces.clear()
    policy.act({**SEEN, "front": numpy.ones((1080, 1920, 3), numpy.uint8)})
    assert stand_in.pieces == [1, 2, 3]
    assert (stand_in.seen[-1]["front"] == 1).all()


class Bomb:
    """A call that makes a file, where it is loaded."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def __reduce__(self) -> Any:
        return os.system, (f"touch {self._path}",)


def hostile(tmp_path: Path) -> dict[str, Any]:
    """Answers of a server that means harm, or that is broken."""
    bomb = Bomb(tmp_path / "bomb")
    inside = Tensor(StorageBytes(pickle.dumps(bomb)), 0, (3,))
    return {
        "a pickle bomb": (pickle.dumps(bomb), "which is not read"),
        "a bomb in the list": (pickle.dumps([bomb]), "which is not read"),
        "a bomb in a tensor": (wired([TimedAction(0.0, 1, inside)]), "which is not read"),
        "numbers of the wrong kind": (answered([[1, 2, 3]], 0.0, 1, LongStorage), "torch.LongStorage"),
        "no numbers": ([[float("nan")] * 3], "no finite numbers"),
        "infinite numbers": ([[float("inf")] * 3], "no finite numbers"),
        "too few": ([[1.0, 2.0]], "shape"),
        "different lengths": ([[1.0, 2.0, 3.0], [1.0, 2.0]], "different lengths"),
        "nothing": (None, "answered no actions"),
        "an empty list": (wired([]), "different lengths, or none"),
        "garbage": (b"\x00" * 100, "unreadable answer"),
        "an answer to another": (answered(rows(), 0.0, 99), "answered another observation"),
        "an answer to another of the same step": (answered(rows(), 10.0, 1), "answered another observation"),
        "steps out of order": (
            wired([TimedAction(0.0, step, Tensor(StorageBytes(b""), 0, (3,))) for step in (2, 1)]),
            "unreadable answer",
        ),
    }


@pytest.mark.parametrize("what", hostile(Path()))
def test_a_hostile_answer_is_refused_by_name_and_does_nothing(
    stand_in: Any, made: Any, tmp_path: Path, what: str
) -> None:
    policy = made(stand_in.url)
    answer, words = hostile(tmp_path)[what]
    stand_in.answer = lambda observation: answer
    with pytest.raises(PolicyServerError, match=words):
        policy.act(SEEN)
    assert list(tmp_path.iterdir()) == []
    policy.close()
    assert policy.warm() == "", "the server is asked anew before the next task"
    eventually(lambda: policy.warm() != "", what="the end of that attempt")


def test_the_answer_to_another_clients_observation_of_the_same_step_moves_nothing(
    stand_in: Any, made: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy = made(stand_in.url)
    call = policy._connection._call
    other = {"timestamp": 10.0, "timestep": 1, "observation": {**SEEN, "pan.pos": -90.0}, "must_go": True}

    def overtaken(method: str, message: Any, *rest: Any) -> Any:
        if method == "GetActions":
            call("SendObservations", _pieces(pickled("TimedObservation", other)), *rest)
        return call(method, message, *rest)

    monkeypatch.setattr(policy._connection, "_call", overtaken)
    with pytest.raises(PolicyServerError, match="answered another observation"):
        policy.act(SEEN)
    assert stand_in.seen[-1] == other["observation"]


def test_an_answer_of_another_message_is_refused(stand_in: Any, made: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    policy = made(stand_in.url)
    for message in (b"\x08\x01", b"\x0a\xff\xff\xff\xff\x7f", b"\x0a\x05ab", b"\x0a", b"\x12\x01a"):
        monkeypatch.setattr("fixtures.lerobot_async_server.message_of", lambda data, message=message: message)
        with pytest.raises(PolicyServerError, match=r"none of LeRobot's|answered no actions"):
            policy.act(SEEN)


def test_an_answer_that_missed_its_deadline_is_never_taken_for_the_next_one(stand_in: Any, made: Any) -> None:
    policy = made(stand_in.url, deadline_s=0.5)
    let_go = threading.Event()

    def slow(observation: dict[str, Any]) -> Any:
        stand_in.answer = lambda observation: rows(first=50.0)
        assert let_go.wait(60)
        return rows(first=9.0)

    stand_in.answer = slow
    with pytest.raises(PolicyServerError, match="did not answer in time"):
        policy.act(SEEN)
    let_go.set()
    assert eventually(lambda: _first(policy)) == 50.0


def _first(policy: LeRobotAsyncPolicy) -> float:
    try:
        return policy.act(SEEN)[0]["pan.pos"]
    except PolicyServerError:
        return 0.0


def test_a_stop_ends_the_wait_for_a_hung_server(stand_in: Any, made: Any) -> None:
    policy = made(stand_in.url, deadline_s=600.0)
    asked, let_go, failed = threading.Event(), threading.Event(), list[str]()

    def hang(observation: dict[str, Any]) -> Any:
        asked.set()
        let_go.wait(60)
        return rows()

    stand_in.answer = hang

    def act() -> None:
        try:
            policy.act(SEEN)
        except PolicyServerError as exc:
            failed.append(str(exc))

    thread = threading.Thread(target=act)
    thread.start()
    assert asked.wait(60)
    policy.interrupt()
    thread.join(60)
    assert not thread.is_alive()
    assert "the task was stopped" in failed[0]
    let_go.set()


def test_a_server_that_has_gone_is_named_and_its_successor_is_asked_anew(made: Any) -> None:
    first = LeRobotAsyncServer(lambda observation: rows())
    with first:
        policy = made(first.url)
        assert policy.act(SEEN)
    with pytest.raises(PolicyServerError, match=f"no policy server answers at {first.url}"):
        policy.act(SEEN)
    policy.close()
    with LeRobotAsyncServer(lambda observation: rows(first=7.0), port=first.port) as second:
        eventually(lambda: _reset(policy), within=240.0)
        assert policy.act(SEEN)[0]["pan.pos"] == 7.0
        assert second.called == ["Ready", "SendPolicyInstructions"], "it has loaded nothing before"


def test_a_server_that_refuses_to_load_is_named_and_left_to_others(made: Any) -> None:
    with LeRobotAsyncServer(lambda observation: rows(), refuses="no such checkpoint") as server:
        with pytest.raises(PolicyServerError, match=r"SendPolicyInstructions: UNKNOWN.*no such checkpoint"):
            made(server.url)
        server.refuses = ""
        LeRobotAsyncConnection(profile(server.url)).close()


def test_no_server_is_told_where_it_was_looked_for() -> None:
    url = f"grpc://127.0.0.1:{free_port()}"
    with pytest.raises(PolicyServerError, match=f"no policy server answers at {url}"):
        LeRobotAsyncPolicy(profile(url)).reset("wave", RANGES)


@pytest.mark.parametrize("url", ["grpc://10.1.2.3:8080", "grpc://gpu.local:8080", "ws://127.0.0.1:8080"])
def test_a_server_that_is_not_on_this_machine_needs_a_tunnel(url: str) -> None:
    with pytest.raises(ValidationError, match="url must be grpc:// on this machine"):
        LeRobotAsyncPolicy(profile(url))


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"environment": ("cube.x",)}, "takes no environment"),
        ({"cameras": (CameraMap("webcam", "pan.pos"),)}, "names of their own, not pan.pos"),
        ({"cameras": (CameraMap("webcam", "task"),)}, "names of their own, not task"),
    ],
)
def test_a_profile_that_the_wire_cannot_carry_is_refused(changed: dict[str, Any], words: str) -> None:
    with pytest.raises(ValidationError, match=words):
        LeRobotAsyncPolicy(profile("grpc://127.0.0.1", **changed))


def test_an_arm_moves_by_it_once_it_is_warm_and_a_stop_ends_it(
    stand_in: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stand_in.answer = lambda observation: [[12.0, 12.0, 12.0]] * 4
    entries = {"provider": "lerobot_async", "url": stand_in.url, "checkpoint": "x/y", "policy_type": "act"}
    entries |= {"state": list(JOINTS), "action": list(JOINTS), "rate": 25, "confirmed": ["units"], "deadline_s": 20.0}
    file = tmp_path / "policies.toml"
    file.write_text("\n".join(["[pick]", *(f"{key} = {json.dumps(value)}" for key, value in entries.items())]))
    monkeypatch.setenv("STRANDS_POLICIES", str(file))
    assert load_profiles(file)["pick"].policy_type == "act"
    assert create_policy("pick")
    robot = HardwareRobot(RecordingDevice(), "arm")
    robot.connect()
    try:
        eventually(lambda: robot.start_task("pick up the cube", policy_provider="pick")["status"] == "success")
        eventually(lambda: set(robot.device.positions.values()) == {12.0})
        assert robot.halt("test").stopped is True
        eventually(lambda: not robot.occupied("arm"))
        assert stand_in.seen[-1]["task"] == "pick up the cube"
    finally:
        robot.cleanup()
