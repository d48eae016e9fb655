"""The openpi client against a wire-level stand-in of its server, on a real socket."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import msgpack
import numpy
import pytest
from fixtures.broken_frames import answers_read, with_a_byte_changed
from fixtures.devices import RANGES, RecordingDevice
from fixtures.openpi_server import OpenPiServer, packed
from fixtures.waiting import eventually, free_port

from strands_robots.hardware import HardwareRobot
from strands_robots.policies import create_policy
from strands_robots.policies.openpi import OpenPiPolicy
from strands_robots.policies.policy_server import PolicyServerError
from strands_robots.policies.profiles import CameraMap, Profile
from strands_robots.utils import ValidationError

KEYS = ("grip.pos", "pan.pos", "lift.pos")
SEEN = {"grip.pos": 1.0, "pan.pos": 2.0, "lift.pos": 3.0}

Make = Callable[..., tuple[OpenPiServer, OpenPiPolicy]]


def chunk(steps: int = 4, size: int = 3) -> dict[str, Any]:
    values = numpy.arange(steps * size, dtype=numpy.float32).reshape(steps, size)
    return {"actions": values, "policy_timing": {"infer_ms": numpy.float64(12.5)}}


@pytest.fixture
def make() -> Iterator[Make]:
    """A server and a policy of it, reset."""
    with ExitStack() as stack:

        def made(answer: Any = None, *, reset: bool = True, **more: Any) -> tuple[OpenPiServer, OpenPiPolicy]:
            own = {name: more.pop(name) for name in ("metadata", "token") if name in more}
            server = stack.enter_context(OpenPiServer(answer or (lambda observation: chunk()), **own))
            entries = {"url": server.url, "first_deadline_s": 20.0, "deadline_s": 20.0} | more
            policy = OpenPiPolicy(Profile("pi", "openpi", KEYS, KEYS, **entries))
            if reset:
                policy.reset("pick up the cube", RANGES)
                stack.callback(policy.close)
            return server, policy

        yield made


def test_an_answer_is_a_chunk_by_the_profiles_action_keys(make: Make) -> None:
    server, policy = make()
    actions = policy.act(SEEN)
    assert actions[0] == {"grip.pos": 0.0, "pan.pos": 1.0, "lift.pos": 2.0}
    assert len(actions) == 4
    asked = server.seen[-1]
    assert asked["observation/state"].tolist() == [1.0, 2.0, 3.0]
    assert asked["observation/state"].dtype == numpy.float32
    assert asked["prompt"] == "pick up the cube"


def test_pictures_go_under_their_keys_as_bytes(make: Make) -> None:
    cameras = (CameraMap("front", "observation/image", size=(6, 8)),)
    server, policy = make(cameras=cameras)
    image = numpy.arange(6 * 8 * 3, dtype=numpy.uint8).reshape(6, 8, 3)
    policy.act({**SEEN, "observation/image": image})
    assert (server.seen[-1]["observation/image"] == image).all()
    assert server.seen[0]["observation/image"].shape == (6, 8, 3), "the first inference has a blank one"


def test_aloha_has_one_state_and_pictures_channel_first(make: Make) -> None:
    cameras = (CameraMap("high", "cam_high", size=(6, 8)),)
    server, policy = make(layout="aloha", cameras=cameras)
    policy.act({**SEEN, "cam_high": numpy.zeros((6, 8, 3), numpy.uint8)})
    assert set(server.seen[-1]) == {"state", "images", "prompt"}
    assert server.seen[-1]["images"]["cam_high"].shape == (3, 6, 8)


def test_droid_has_joints_and_gripper_apart() -> None:
    keys = tuple(f"joint_{number}" for number in range(7))
    with OpenPiServer(lambda observation: chunk(size=8)) as server:
        state = (*keys, "gripper")
        policy = OpenPiPolicy(Profile("pi", "openpi", state, state, url=server.url, layout="droid"))
        policy.reset("open the drawer", {})
        policy.act({key: float(number) for number, key in enumerate(state)})
        assert server.seen[-1]["observation/joint_position"].shape == (7,)
        assert server.seen[-1]["observation/gripper_position"].tolist() == [7.0]
        policy.close()
    with pytest.raises(ValidationError, match="layout droid"):
        OpenPiPolicy(Profile("pi", "openpi", KEYS, KEYS, url="ws://localhost", layout="droid"))


def test_an_answer_with_any_byte_changed_is_read_or_refused(make: Make) -> None:
    frames = with_a_byte_changed(msgpack.packb(chunk(), default=packed))
    answers = iter([chunk(), *frames])
    _, policy = make(lambda observation: next(answers))
    assert 0 < answers_read(policy, SEEN, len(frames)) < len(frames)


def test_a_batch_axis_is_taken_off(make: Make) -> None:
    _, policy = make(lambda observation: {"actions": numpy.zeros((1, 5, 3), numpy.float32)})
    assert len(policy.act(SEEN)) == 5


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        ({"actions": numpy.zeros((4, 5), numpy.float32)}, r"shape \(4, 5\), and the profile has 3 keys"),
        ({"actions": numpy.zeros((0, 3), numpy.float32)}, "shape"),
        ({"actions": numpy.zeros(3, numpy.float32)}, "shape"),
        ({"actions": numpy.full((4, 3), numpy.nan, numpy.float32)}, "no finite numbers"),
        ({"actions": numpy.full((4, 3), True)}, "no finite numbers"),
        ({"type": "error", "message": "out of memory"}, "out of memory"),
        ({"state": 1}, "without actions"),
        ("Traceback (most recent call last):\nRuntimeError: bad camera", "failed: RuntimeError: bad camera"),
        (b"\xc1", "cannot be read"),
        ([1, 2], "answered"),
        ({"actions": {b"__ndarray__": True, b"data": b"12", b"dtype": "<f4", b"shape": [4, 3]}}, "cannot be read"),
        ({"actions": {b"__npgeneric__": True, b"data": "x", b"dtype": "<f4"}}, "in place of numbers"),
        ({"actions": ["x" * 1000, *range(1000)]}, "in place of numbers"),
        ({"actions": [[1.0, 2.0, 3.0], [1.0]]}, "no array"),
        ({"actions": {b"__ndarray__": True, b"data": b"12345678", b"dtype": "|O", b"shape": [1]}}, "cannot be read"),
    ],
    ids=lambda value: str(value)[:40],
)
def test_an_unusable_answer_to_the_first_inference_is_told_before_anything_moves(
    make: Make, answer: Any, words: str
) -> None:
    with pytest.raises(PolicyServerError, match=words):
        make(lambda observation: answer)


@pytest.mark.parametrize(
    ("metadata", "entries", "words"),
    [
        ({"action_keys": ["pan.pos", "lift.pos", "grip.pos"]}, {}, "action_keys"),
        ({"action_horizon": 10}, {"chunk": 50}, "action_horizon is 10"),
    ],
)
def test_metadata_that_contradicts_the_profile_is_refused(
    make: Make, metadata: dict[str, Any], entries: dict[str, Any], words: str
) -> None:
    with pytest.raises(PolicyServerError, match=words):
        make(metadata=metadata, **entries)


def test_a_late_answer_is_never_taken_for_the_next_one(make: Make) -> None:
    let_go = threading.Event()
    late = numpy.full((4, 3), 9.0, numpy.float32)
    server, policy = make(deadline_s=0.2)

    def slow(observation: dict[str, Any]) -> Any:
        server.answer = lambda observation: chunk()
        assert let_go.wait(20)
        return {"actions": late}

    server.answer = slow
    with pytest.raises(PolicyServerError, match="did not answer in time"):
        policy.act(SEEN)
    let_go.set()
    eventually(lambda: _acted(policy), what="an answer on a new connection")
    assert policy.act(SEEN)[0]["grip.pos"] == 0.0
    assert server.connections >= 2


def _acted(policy: OpenPiPolicy) -> bool:
    try:
        return policy.act(SEEN)[0]["grip.pos"] == 0.0
    except PolicyServerError:
        return False


def test_a_server_that_hung_up_while_idle_is_asked_again(make: Make) -> None:
    server, policy = make()

    def hang_up(observation: dict[str, Any]) -> Any:
        server.answer = lambda observation: chunk()
        raise ConnectionAbortedError

    server.answer = hang_up
    assert policy.act(SEEN)[0]["grip.pos"] == 0.0
    assert server.connections == 2


def test_a_stop_ends_a_hung_inference_at_once(make: Make) -> None:
    server, policy = make()
    let_go, asked, failed = threading.Event(), threading.Event(), list[str]()

    def hang(observation: dict[str, Any]) -> Any:
        asked.set()
        let_go.wait(60)
        return chunk()

    server.answer = hang

    def act() -> None:
        try:
            policy.act(SEEN)
        except PolicyServerError as exc:
            failed.append(str(exc))

    thread = threading.Thread(target=act)
    thread.start()
    assert asked.wait(20)
    policy.interrupt()
    thread.join(20)
    assert "the task was stopped" in failed[0]
    let_go.set()


def test_the_token_of_the_profiles_file_is_sent(make: Make, tmp_path: Path) -> None:
    file = tmp_path / "token"
    file.write_text("secret\n")
    _, policy = make(token="secret", token_file=str(file))
    assert policy.act(SEEN)
    with pytest.raises(PolicyServerError):
        make(token="another", token_file=str(file), first_deadline_s=2.0)
    with pytest.raises(ValidationError, match="token_file cannot be read"):
        make(token_file=str(tmp_path / "none"))


def test_without_a_server_it_says_where_it_looked() -> None:
    url = f"ws://127.0.0.1:{free_port()}"
    policy = OpenPiPolicy(Profile("pi", "openpi", KEYS, KEYS, url=url, first_deadline_s=2.0))
    with pytest.raises(PolicyServerError, match=url):
        policy.reset("wave", {})


def test_it_is_made_from_a_profile_alone() -> None:
    with pytest.raises(ValidationError, match="needs a profile"):
        create_policy("openpi")


def test_an_arm_moves_by_it_once_it_is_warm_and_a_stop_ends_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    compiled = threading.Event()

    def answer(observation: dict[str, Any]) -> Any:
        # The first inference compiles.
        assert compiled.wait(60)
        return {"actions": numpy.full((4, 3), 12.0, numpy.float32)}

    with OpenPiServer(answer) as server:
        file = tmp_path / "policies.toml"
        keys = '["grip.pos", "pan.pos", "lift.pos"]'
        lines = ['provider = "openpi"', f'url = "{server.url}"', f"state = {keys}", f"action = {keys}"]
        file.write_text("\n".join(["[pick]", *lines, 'rate = 25\nconfirmed = ["units"]']))
        monkeypatch.setenv("STRANDS_POLICIES", str(file))
        robot = HardwareRobot(RecordingDevice(), "arm")
        robot.connect()
        loading = robot.start_task("pick up the cube", policy_provider="pick")
        assert (loading["status"], loading["loading"]) == ("error", True)
        assert robot.device.writes == []
        compiled.set()
        eventually(lambda: robot.start_task("pick up the cube", policy_provider="pick")["status"] == "success")
        eventually(lambda: robot.device.positions == dict.fromkeys(KEYS, 12.0))
        assert server.seen[-1]["prompt"] == "pick up the cube"
        verdict = robot.halt("test")
        at = time.monotonic()
        assert verdict.stopped is True, verdict
        eventually(lambda: not robot.occupied("arm"))
        assert robot.device.written_after(at) == []
        robot.cleanup()
