"""The reader of LeRobot's answers: lists of actions are read, and nothing else; nothing is ever imported or called."""

from __future__ import annotations

import os
import pickle
import struct
from pathlib import Path
from typing import Any

import numpy
import pytest
from fixtures.lerobot_pickles import (
    DoubleStorage,
    LongStorage,
    Storage,
    StorageBytes,
    Tensor,
    TimedAction,
    answered,
    received,
    wired,
)

from strands_robots.policies import lerobot_async as module
from strands_robots.policies.lerobot_async import UnreadablePickleError, pickled, read_actions

ROWS = [[1.0, 2.0, 3.0], [4.0, 5.0, 6.5]]


def action(tensor: Any, timestamp: Any = 0.0, timestep: Any = 0) -> bytes:
    return wired([TimedAction(timestamp, timestep, tensor)])


def tensor(numbers: list[float] | None = None, offset: Any = 0, size: Any = (3,), stride: Any = (1,)) -> Tensor:
    return Tensor(StorageBytes(Storage(numbers or [1.0, 2.0, 3.0]).file()), offset, size, stride)


@pytest.mark.parametrize("kind", ["float", "double"])
def test_the_actions_of_an_answer_are_read_with_their_steps(kind: str) -> None:
    data = answered(ROWS, 10.0, 7, DoubleStorage) if kind == "double" else answered(ROWS, 10.0, 7)
    assert [(each.timestep, list(each.values)) for each in read_actions(data)] == [(7, ROWS[0]), (8, ROWS[1])]


@pytest.mark.parametrize("protocol", [3, 4, 5])
def test_each_protocol_that_has_bytes_is_read(protocol: int) -> None:
    data = wired([TimedAction(0.5, 3, tensor())], protocol)
    assert read_actions(data)[0].values == (1.0, 2.0, 3.0)


class Call:
    """Pickles as a call."""

    def __init__(self, function: Any, *arguments: Any) -> None:
        self._parts = function, arguments

    def __reduce__(self) -> Any:
        return self._parts


class Key:
    """A key whose hash is asked for when a map is loaded."""

    def __init__(self, inside: Any) -> None:
        self.inside = inside


def bomb(path: Path) -> Call:
    return Call(os.system, f"touch {path}")


@pytest.mark.parametrize("protocol", [0, 1, 2, 3, 4, 5])
@pytest.mark.parametrize("place", ["whole", "item", "action", "inside a tensor's file", "state", "key"])
def test_a_pickle_bomb_is_refused_and_does_nothing(tmp_path: Path, protocol: int, place: str) -> None:
    goes_off = bomb(tmp_path / "bomb")
    inner = pickle.dumps(goes_off, protocol)
    data = {
        "whole": inner,
        "item": pickle.dumps([goes_off], protocol),
        "action": wired([TimedAction(0.0, 0, goes_off)], max(protocol, 2)),
        "inside a tensor's file": action(Tensor(StorageBytes(inner), 0, (3,))),
        "state": wired([TimedAction(0.0, goes_off, tensor())], max(protocol, 2)),
        "key": pickle.dumps([{Key(goes_off): 1}], protocol),
    }[place]
    with pytest.raises(UnreadablePickleError):
        read_actions(data)
    assert list(tmp_path.iterdir()) == []


def test_the_bomb_of_these_tests_goes_off_where_pickles_are_loaded(tmp_path: Path) -> None:
    pickle.loads(pickle.dumps(bomb(tmp_path / "bomb")))
    assert (tmp_path / "bomb").exists()


@pytest.mark.parametrize(
    "name",
    [
        "builtins eval",
        "builtins getattr",
        "os system",
        "posix system",
        "torch load",
        "torch.serialization load",
        "torch._utils _rebuild_tensor_v2.__globals__",
        "lerobot.async_inference.helpers TimedAction.__init__",
        "lerobot.async_inference.helpers RemotePolicyConfig",
        "collections OrderedDict.fromkeys",
        "numpy.core.multiarray _reconstruct",
        "strands_robots.policies.lerobot_async read_actions",
    ],
)
def test_a_name_that_is_not_listed_ends_the_reading(name: str) -> None:
    space = name.index(" ")
    for data in (
        b"\x80\x02c" + f"{name[:space]}\n{name[space + 1 :]}\n".encode() + b"(tR.",
        b"\x80\x04\x8c" + bytes([space]) + name[:space].encode() + b"\x8c" + bytes([len(name) - space - 1])
        + name[space + 1 :].encode() + b"\x93)R.",
    ):  # fmt: skip
        with pytest.raises(UnreadablePickleError, match="is not read"):
            read_actions(data)


STRANGE = {
    "a name of the extension registry": b"\x80\x02\x82\x01.",
    "an instance by INST": b"(S'touch x'\nios\nsystem\n.",
    "an object by OBJ": b"(cos\nsystem\nS'x'\no.",
    "a call with keywords": b"\x80\x04)}\x92.",
    "a memo of four thousand million": b"\x80\x02]r\xff\xff\xff\xff" + b"j\x00\x00\x00\x00.",
    "bytes that are announced and not there": b"\x80\x03B\xff\xff\xff\xff.",
    "eight bytes of length": b"\x80\x04\x8e\xff\xff\xff\xff\xff\xff\xff\x7f.",
    "nothing": b"",
    "no pickle": b"\xff\xff",
    "text": b"Traceback (most recent call last)",
    "an item of nothing": b"\x80\x02a.",
    "a tuple of nothing": b"\x80\x02\x87.",
    "items without a mark": b"\x80\x02]e.",
    "two values": b"\x80\x02]].",
    "a call of a list": b"\x80\x02])R.",
    "attributes of a list": b"\x80\x02]}b.",
    "no list": b"\x80\x02}.",
    "a memory that is not there": b"\x80\x02h\x07.",
    "items of a list that is in itself": b"\x80\x02]q\x00h\x00a.",
    "a list of lists that grows twice at each step": b"\x80\x02" + b"]q\x00" + b"(h\x00h\x00l" * 40 + b".",
    "a key that is a tuple": b"\x80\x02}))s.",
    "a name of tuples": b"\x80\x04" + (b")" + b"q\x00h\x00\x86" * 60) + b"\x8c\x01x\x93.",
    "a class of tuples": b"\x80\x04\x8c\x01x" + (b")" + b"q\x00h\x00\x86" * 60) + b"\x93.",
    "the deepest list": b"\x80\x02" + b"]" * 200_000 + b"a" * 199_999 + b".",
    "a pickle without an end": pickle.dumps(list(range(100)))[:-1],
}


@pytest.mark.parametrize("what", STRANGE)
def test_a_strange_pickle_is_refused(what: str) -> None:
    with pytest.raises(UnreadablePickleError):
        read_actions(STRANGE[what])


def test_an_answer_of_endless_operations_is_given_up() -> None:
    with pytest.raises(UnreadablePickleError, match="more than 15,000 operations"):
        read_actions(b"\x80\x02" + b"N" * 30_000 + b".")


def test_bytes_that_stand_for_many_tensors_are_counted_each_time() -> None:
    slow = StorageBytes(b"\x80\x02" + b"N" * 2_000 + b"].")
    many = wired([TimedAction(0.0, index, Tensor(slow, 0, (3,))) for index in range(1000)])
    assert len(many) < 200_000
    with pytest.raises(UnreadablePickleError):
        read_actions(many)


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (answered([[1, 2]], 0.0, 0, LongStorage), "torch.LongStorage"),
        (action(tensor(size=(4,))), "more numbers than its bytes"),
        (action(tensor(offset=1)), "more numbers than its bytes"),
        (action(tensor(offset=-1)), "flat tensor"),
        (action(tensor(size=(3,), stride=(0,))), "flat tensor"),
        (action(tensor(size=(1, 3), stride=(3, 1))), "flat tensor"),
        (action(tensor(size=())), "flat tensor"),
        (action(tensor(size=(0,))), "flat tensor"),
        (action(tensor(size=(2**40,), stride=(1,))), "flat tensor"),
        (action(tensor(size=(True,))), "flat tensor"),
        (action([1.0, 2.0]), "must be a tensor"),
        (action(None), "must be a tensor"),
        (action(tensor(), timestep="3"), "step '3'"),
        (action(tensor(), timestep=True), "step True"),
        (action(tensor(), timestamp=3), "at 3"),
        (wired([{"action": 1}]), "an action was expected"),
        (wired({"a": 1}), "a list of actions"),
        (action(Tensor(StorageBytes(b"PK\x03\x04"), 0, (3,))), "malformed|cut off|not read"),
        (action(Tensor(StorageBytes(Storage([1.0]).file() + b"1234"), 0, (1,))), "not as many as it says"),
        (action(Tensor(StorageBytes(Storage([1.0]).file()[:-2]), 0, (1,))), "not as many as it says"),
        (action(Tensor(StorageBytes(Storage([]).file()[:-8]), 0, (1,))), "not as many as it says"),
    ],
    ids=lambda value: None if isinstance(value, bytes) else value,
)
def test_what_is_no_flat_tensor_of_floats_is_refused_by_name(data: bytes, words: str) -> None:
    with pytest.raises(UnreadablePickleError, match=words):
        read_actions(data)


TUPLES = b")" + b"q\x00h\x00\x86" * 60
"""A tuple of twice the tuple before, sixty deep: to compare two of them, or to write one, takes 2**60 steps."""
ITSELF = b"]q\x00h\x00a"
"""A list that is in itself."""


def pieces() -> list[bytes]:
    """The five pickles of a tensor's file, and its numbers."""
    system = {"protocol_version": 1001, "little_endian": True}
    storage = Storage([1.0, 2.0, 3.0])
    made = [wired(each, 2) for each in (0x1950A86A20F9469CFC6C, 1001, system, storage, ["94"])]
    return [*made, struct.pack("<q3f", 3, 1.0, 2.0, 3.0)]


def in_file(made: list[bytes]) -> bytes:
    return action(Tensor(StorageBytes(b"".join(made)), 0, (3,)))


@pytest.mark.parametrize("inner", [TUPLES, ITSELF], ids=["tuples", "a list in itself"])
def test_parts_of_a_tensors_file_that_never_end_to_compare_are_refused_uncompared(inner: bytes) -> None:
    assert read_actions(in_file(pieces()))
    whole = b"\x80\x02" + inner + b"."
    keys = b"\x80\x02]" + inner + b"a."
    with_key = pieces()[3].replace(b"X\x02\x00\x00\x0094", inner)
    with_word = pieces()[3].replace(b"X\x07\x00\x00\x00storage", inner)
    assert inner in with_key
    assert inner in with_word
    for changed in (
        {0: whole},
        {1: whole},
        {3: with_word},
        {3: with_key},
        {4: whole},
        {4: keys},
        {3: with_key, 4: keys},
    ):
        made = [changed.get(index, each) for index, each in enumerate(pieces())]
        with pytest.raises(UnreadablePickleError, match=r"another format|one storage|float32"):
            read_actions(in_file(made))


def test_one_action_that_stands_in_the_list_many_times_is_counted_each_time() -> None:
    numbers = [0.0] * module.SIZE_MAX
    one = TimedAction(0.0, 0, tensor(numbers, size=(module.SIZE_MAX,)))
    many = wired([one] * 1000)
    assert len(many) < 25_000
    with pytest.raises(UnreadablePickleError, match="more than 32,768 numbers"):
        read_actions(many)
    assert len(read_actions(wired([one] * 8))) == 8


def test_a_tensors_file_holds_no_bytes_before_its_numbers() -> None:
    more = pickle.dumps(b"x" * module.HEADER_MAX, 3)
    made = pieces()
    for changed in ({2: more}, {3: made[3].replace(b"Nt", more[2:-1] + b"t")}):
        with pytest.raises(UnreadablePickleError, match=r"malformed|cut off"):
            read_actions(in_file([changed.get(index, each) for index, each in enumerate(made)]))


def test_a_file_that_says_more_than_it_has_is_refused() -> None:
    file = Storage([1.0, 2.0, 3.0]).file()
    assert file.endswith(struct.pack("<q3f", 3, 1.0, 2.0, 3.0))
    for count in (2, 4, -1, 2**62):
        with pytest.raises(UnreadablePickleError, match="not as many as it says"):
            read_actions(action(Tensor(StorageBytes(file[:-20] + struct.pack("<q", count) + file[-12:]), 0, (3,))))


def test_what_is_cut_off_anywhere_is_refused() -> None:
    whole = answered(ROWS, 0.0, 0)
    for length in range(len(whole)):
        with pytest.raises(UnreadablePickleError):
            read_actions(whole[:length])


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_turned_bit_never_does_more_than_refuse_or_change_a_number(monkeypatch: pytest.MonkeyPatch) -> None:
    def looked_up(*_: object) -> None:
        raise AssertionError("something was looked up")

    monkeypatch.setattr(pickle, "loads", looked_up)
    monkeypatch.setattr(pickle, "load", looked_up)
    monkeypatch.setattr(pickle, "Unpickler", looked_up)
    whole = answered(ROWS[:1], 0.0, 0)
    for at in range(len(whole)):
        for bit in range(8):
            turned = bytearray(whole)
            turned[at] ^= 1 << bit
            try:
                found = read_actions(bytes(turned))
            except UnreadablePickleError:
                continue
            assert all(isinstance(number, float) for each in found for number in each.values)


def test_the_module_never_loads_a_pickle() -> None:
    source = Path(module.__file__).read_text(encoding="utf-8")
    assert source.count("pickle.loads") == 1, "in its docstring"
    assert "Unpickler" not in source
    assert "find_class" not in source


def test_what_is_written_is_an_object_of_lerobots_class() -> None:
    image = numpy.arange(24, dtype=numpy.uint8).reshape(2, 4, 3)
    state = {"timestep": 3, "observation": {"pan.pos": 1.5, "front": image, "task": "wave"}, "must_go": True}
    found = received(pickled("TimedObservation", state))
    assert type(found).__name__ == "TimedObservation"
    assert (found.timestep, found.must_go, found.observation["task"]) == (3, True, "wave")
    assert (found.observation["front"] == image).all()
