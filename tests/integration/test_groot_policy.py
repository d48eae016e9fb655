"""The GR00T client against a wire-level stand-in of its server, on a real socket."""

from __future__ import annotations

import io
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
from fixtures.devices import RANGES
from fixtures.groot_server import GrootServer, packed
from fixtures.waiting import eventually, free_port

from strands_robots.policies import create_policy
from strands_robots.policies.groot import GrootPolicy
from strands_robots.policies.policy_server import PolicyServerError
from strands_robots.policies.profiles import CameraMap, Profile, load_profiles
from strands_robots.utils import ValidationError

KEYS = ("pan.pos", "lift.pos", "grip.pos")
PARTS = {"single_arm": ("pan.pos", "lift.pos"), "gripper": ("grip.pos",)}
SEEN = {"pan.pos": 1.0, "lift.pos": 2.0, "grip.pos": 3.0}
FRONT = (CameraMap("front", "front", size=(6, 8)),)

Make = Callable[..., tuple[GrootServer, GrootPolicy]]


def newer(steps: int = 16) -> list[Any]:
    """An answer of N1.6 and N1.7."""
    arm = numpy.arange(steps * 2, dtype=numpy.float32).reshape(1, steps, 2)
    return [{"single_arm": arm, "gripper": numpy.full((1, steps, 1), 9, numpy.float32)}, {}]


def older(steps: int = 16) -> dict[str, Any]:
    """An answer of N1.5, whose parts of one number may be flat."""
    arm = numpy.arange(steps * 2, dtype=numpy.float64).reshape(steps, 2)
    return {"action.single_arm": arm, "action.gripper": numpy.full(steps, 9.0)}


def modality(keys: list[str], deltas: list[int]) -> dict[str, Any]:
    return {"__ModalityConfig_class__": True, "as_json": {"modality_keys": keys, "delta_indices": deltas}}


def in_place_of_an_array(file: Any) -> list[Any]:
    """An answer of which one array is something else."""
    return [{"single_arm": {"__ndarray_class__": True, "as_npy": file}, "gripper": numpy.zeros((1, 1, 1))}, {}]


def archive() -> bytes:
    file = io.BytesIO()
    numpy.savez(file, actions=numpy.zeros(3))
    return file.getvalue()


def stating(shape: tuple[int, ...]) -> bytes:
    """An array without its bytes."""
    file = io.BytesIO()
    numpy.lib.format.write_array_header_1_0(file, {"descr": "<f4", "fortran_order": False, "shape": shape})
    return file.getvalue()


@pytest.fixture
def make() -> Iterator[Make]:
    """A server and a policy of it, reset."""
    with ExitStack() as stack:

        def made(answer: Any = None, *, reset: bool = True, **more: Any) -> tuple[GrootServer, GrootPolicy]:
            own = {name: more.pop(name) for name in ("config", "token", "resets") if name in more}
            server = stack.enter_context(GrootServer(answer or (lambda data: newer()), **own))
            entries = {"url": server.url, "first_deadline_s": 20.0, "deadline_s": 20.0, "parts": PARTS} | more
            policy = GrootPolicy(Profile("gr", "groot", KEYS, KEYS, **entries))
            if reset:
                policy.reset("pick up the cube", RANGES)
                stack.callback(policy.close)
            return server, policy

        yield made


def test_an_observation_of_n1_6_has_a_batch_and_a_time_axis(make: Make) -> None:
    server, policy = make(cameras=FRONT)
    image = numpy.arange(6 * 8 * 3, dtype=numpy.uint8).reshape(6, 8, 3)
    actions = policy.act({**SEEN, "front": image})
    assert len(actions) == 16
    assert actions[1] == {"pan.pos": 2.0, "lift.pos": 3.0, "grip.pos": 9.0}
    assert "reset" in server.asked
    seen = server.seen[-1]["observation"]
    assert (seen["video"]["front"] == image[None, None]).all()
    assert seen["state"]["single_arm"].dtype == numpy.float32
    assert seen["state"]["single_arm"].tolist() == [[[1.0, 2.0]]]
    assert seen["state"]["gripper"].tolist() == [[[3.0]]]
    assert seen["language"] == {"annotation.human.task_description": [["pick up the cube"]]}


def test_the_wrapper_for_simulations_takes_flat_keys(make: Make) -> None:
    server, policy = make(layout="n1.6-flat", cameras=FRONT)
    policy.act({**SEEN, "front": numpy.zeros((6, 8, 3), numpy.uint8)})
    seen = server.seen[-1]["observation"]
    assert seen["video.front"].shape == (1, 1, 6, 8, 3)
    assert seen["state.gripper"].shape == (1, 1, 1)
    assert seen["annotation.human.task_description"] == ["pick up the cube"]


def test_n1_5_takes_float64_without_a_batch_axis_and_knows_no_reset(make: Make) -> None:
    server, policy = make(lambda data: older(), layout="n1.5", cameras=FRONT, resets=False)
    actions = policy.act({**SEEN, "front": numpy.zeros((6, 8, 3), numpy.uint8)})
    assert actions[0] == {"pan.pos": 0.0, "lift.pos": 1.0, "grip.pos": 9.0}
    seen = server.seen[-1]
    assert seen["video.front"].shape == (1, 6, 8, 3)
    assert seen["state.single_arm"].dtype == numpy.float64
    assert seen["state.single_arm"].tolist() == [[1.0, 2.0]]
    assert "reset" not in server.asked


@pytest.mark.parametrize(
    ("config", "words"),
    [
        ({"state": modality(["single_arm"], [0])}, r"modality state is .*'single_arm'.*'gripper', 'single_arm'"),
        ({"action": modality(["action.single_arm"], [0])}, "modality action"),
        ({"video": modality(["wrist"], [0])}, "modality video"),
        ({"video": modality(["front"], [-15, 0])}, r"video of the steps \[-15, 0\]"),
        ({"action": modality(["single_arm", "gripper"], list(range(16)))}, "horizon is 16, and the profile has 8"),
    ],
)
def test_a_server_that_states_something_else_than_the_profile_is_refused(
    make: Make, config: dict[str, Any], words: str
) -> None:
    server, policy = make(config=config, cameras=FRONT, chunk=8, reset=False)
    with pytest.raises(PolicyServerError, match=words):
        policy.reset("pick up the cube", RANGES)
    assert not server.seen


@pytest.mark.parametrize("form", ["as_json", "as_dict", "text"])
def test_modalities_are_read_in_each_form_of_the_wire(make: Make, form: str) -> None:
    stated: Any = {"modality_keys": ["annotation.task"], "delta_indices": [0]}
    if form == "text":
        config: dict[str, Any] = {"as_json": '{"modality_keys": ["annotation.task"], "delta_indices": [0]}'}
    else:
        config = {form: stated}
    server, first = make(config={"language": {"__ModalityConfig_class__": True, **config}})
    first.close()
    policy = GrootPolicy(first.profile)
    policy.reset("pick up the cube", RANGES)
    policy.act(SEEN)
    policy.close()
    assert server.seen[-1]["observation"]["language"] == {"annotation.task": [["pick up the cube"]]}


def test_an_answer_with_any_byte_changed_is_read_or_refused(make: Make) -> None:
    frames = with_a_byte_changed(msgpack.packb(newer(2), default=packed))
    answers = iter([newer(2), *frames])
    _, policy = make(lambda data: next(answers))
    assert 0 < answers_read(policy, SEEN, len(frames)) < len(frames)


@pytest.mark.parametrize(
    ("answer", "words"),
    [
        ([{"single_arm": numpy.zeros((1, 4, 2), numpy.float32)}, {}], r"answered no gripper; it has \['single_arm'\]"),
        ([{"single_arm": numpy.zeros((1, 4, 3), numpy.float32), "gripper": numpy.zeros((1, 4, 1))}, {}], "shape"),
        ([{"single_arm": numpy.zeros((1, 4, 2)), "gripper": numpy.zeros((1, 5, 1))}, {}], "different lengths"),
        ([{"single_arm": numpy.full((1, 4, 2), numpy.nan), "gripper": numpy.zeros((1, 4, 1))}, {}], "no finite"),
        ({"error": "Observation must be float32"}, "failed: 'Observation must be float32'"),
        (b"\xc1", "unreadable answer"),
        ([], "without actions"),
        ("fine", "without actions"),
        ([{"single_arm": numpy.array([[[None, 1]]]), "gripper": numpy.zeros((1, 1, 1))}, {}], "cannot be read"),
        (in_place_of_an_array(archive()), "cannot be read"),
        (in_place_of_an_array(stating((10**12,))), "cannot be read"),
        (in_place_of_an_array(stating((1, -1, 2)) + bytes(32)), "cannot be read"),
        (in_place_of_an_array(b"\x93NUMPY\x01\x00\x20\x03" + 800 * b"("), "cannot be read"),
        (in_place_of_an_array(7), "cannot be read"),
    ],
    ids=lambda value: str(value)[:40],
)
def test_an_unusable_answer_is_told_before_anything_moves(make: Make, answer: Any, words: str) -> None:
    _, policy = make(lambda data: answer, reset=False)
    with pytest.raises(PolicyServerError, match=words):
        policy.reset("pick up the cube", RANGES)


def test_the_token_goes_with_each_question_and_a_wrong_one_is_told(make: Make, tmp_path: Path) -> None:
    file = tmp_path / "token"
    file.write_text("secret\n", encoding="utf-8")
    _, policy = make(token="secret", token_file=str(file))
    assert policy.act(SEEN)
    _, refused = make(token="other", token_file=str(file), reset=False)
    with pytest.raises(PolicyServerError, match="Invalid api token"):
        refused.reset("pick up the cube", RANGES)


def test_an_answer_that_missed_its_deadline_is_never_taken_for_the_next_one(make: Make) -> None:
    late = threading.Event()
    answers = iter([newer(4), newer(4), None, newer(6)])

    def answer(data: dict[str, Any]) -> Any:
        told = next(answers)
        if told is None:
            late.wait(20)
            return newer(5)
        return told

    _, policy = make(answer, deadline_s=0.2)
    assert len(policy.act(SEEN)) == 4
    with pytest.raises(PolicyServerError, match="did not answer in time"):
        policy.act(SEEN)
    late.set()
    assert eventually(lambda: _length(policy) == 6)


def _length(policy: GrootPolicy) -> int:
    try:
        return len(policy.act(SEEN))
    except PolicyServerError:
        return 0


def test_a_stop_ends_the_wait_for_an_answer(make: Make) -> None:
    asked = threading.Event()
    over = threading.Event()
    first = iter([True])

    def answer(data: dict[str, Any]) -> Any:
        if next(first, False):
            return newer()
        asked.set()
        over.wait(20)
        return newer()

    _, policy = make(answer)
    threading.Thread(target=lambda: asked.wait(20) and policy.interrupt(), daemon=True).start()
    began = time.monotonic()
    with pytest.raises(PolicyServerError, match="the task was stopped"):
        policy.act(SEEN)
    over.set()
    assert time.monotonic() - began < 10


def test_no_server_is_told_with_its_address() -> None:
    url = f"tcp://127.0.0.1:{free_port()}"
    profile = Profile("gr", "groot", KEYS, KEYS, url=url, parts=PARTS, first_deadline_s=0.3)
    with pytest.raises(PolicyServerError, match=f"no policy server answers at {url}"):
        GrootPolicy(profile).reset("pick up the cube", RANGES)


@pytest.mark.parametrize(
    ("parts", "words"),
    [
        ({}, "must name each key of state once"),
        ({"single_arm": KEYS, "gripper": ("grip.pos",)}, "must name each key of state once"),
        ({"single_arm": (*KEYS, "other.pos")}, "single_arm has other.pos, which state lacks"),
    ],
)
def test_parts_that_do_not_fit_the_profile_are_refused(parts: dict[str, tuple[str, ...]], words: str) -> None:
    with pytest.raises(ValidationError, match=words):
        GrootPolicy(Profile("gr", "groot", KEYS, KEYS, url="tcp://localhost:5555", parts=parts))


def test_a_layout_of_another_kind_of_server_is_refused() -> None:
    profile = Profile("gr", "groot", KEYS, KEYS, url="tcp://localhost:5555", parts=PARTS, layout="libero")
    with pytest.raises(ValidationError, match=r"layout of provider groot must be one of n1\.6, n1\.6-flat, n1\.5"):
        GrootPolicy(profile)


def test_a_profile_of_the_file_makes_the_policy(make: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    server, _ = make()
    file = tmp_path / "policies.toml"
    file.write_text(
        f'[gr]\nprovider = "groot"\nurl = "{server.url}"\nstate = ["pan.pos", "lift.pos", "grip.pos"]\n'
        'action = ["pan.pos", "lift.pos", "grip.pos"]\n'
        '[gr.parts]\nsingle_arm = ["pan.pos", "lift.pos"]\ngripper = ["grip.pos"]\n',
        encoding="utf-8",
    )
    assert load_profiles(file)["gr"].parts == PARTS
    monkeypatch.setenv("STRANDS_POLICIES", str(file))
    assert create_policy("gr")
