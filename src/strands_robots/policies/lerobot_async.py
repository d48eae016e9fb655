"""Client of LeRobot's asynchronous inference server: pickles over gRPC.

The reader is an interpreter of its own for the few operations that lists of numbers need. It imports nothing, calls
nothing and sets no attribute: a class or function in a pickle stays its name, and a name that is not listed ends the
reading. ``pickle.loads`` is never used. Format: ``pickletools`` of the standard library; tensors as
``torch._utils._rebuild_tensor_v2`` gets them, their numbers in torch's older file format.

``transport.AsyncInference`` has ``Ready`` and ``SendPolicyInstructions``, with which the client chooses what the server
loads, then ``SendObservations`` and ``GetActions`` for each chunk. Every message holds a pickle; answers are read by
:func:`read_actions` alone. Source: LeRobot 0.4.0 to 0.6.1, ``async_inference/policy_server.py`` and ``helpers.py``,
``transport/services.proto`` and ``transport/utils.py``.

There is no encryption and no authentication, and the server unpickles what it is sent. So it has to be on this
machine, or at the other end of a tunnel. It has one policy and one queue: it serves one robot at a time.
"""

from __future__ import annotations

import io
import itertools
import pickle
import pickletools
import struct
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, BinaryIO
from urllib.parse import urlsplit

from strands_robots.policies.base import Action
from strands_robots.policies.checkpoint import STATE
from strands_robots.policies.policy_server import (
    PolicyServerError,
    ServedPolicy,
    actions_of,
    compare,
    wait_for_answer,
)
from strands_robots.policies.preload import PreloadedModels
from strands_robots.policies.profiles import IMAGES, Profile
from strands_robots.utils import ValidationError, is_loopback_host, optional_module, shown

HELPERS = "lerobot.async_inference.helpers"
"""Module of LeRobot in which the classes of its wire live."""

SIZE_MAX = 4096
"""Most numbers of one action."""

ANSWER_MAX = 4 * 2**20
"""Longest answer, in bytes: each action brings the numbers of its whole chunk, 1.3 MB for a hundred of 32 joints."""

OPERATIONS_MAX = 15_000
"""Most operations of one answer, of which a thousand take a millisecond; a chunk of a hundred actions has 9,000."""

NUMBERS_MAX = 32_768
"""Most numbers of one answer: 1,000 actions of 32 joints."""

HEADER_MAX = 4096
"""Longest part of a tensor's file before its numbers, in bytes; torch writes about 400."""

_TENSOR, _STORAGE, _ORDERED = (
    "torch._utils._rebuild_tensor_v2",
    "torch.storage._load_from_bytes",
    "collections.OrderedDict",
)
_ACTION = f"{HELPERS}.TimedAction"
_KINDS = {"torch.FloatStorage": ("f", 4), "torch.DoubleStorage": ("d", 8)}
_NAMES = frozenset({_TENSOR, _STORAGE, _ORDERED, _ACTION, *_KINDS})

_MAGIC, _VERSION = 0x1950A86A20F9469CFC6C, 1001
"""First two pickles of torch's older file format."""


class UnreadablePickleError(ValidationError):
    """A pickle that is more than a list of actions, or less."""


@dataclass(frozen=True)
class PickledName:
    """Class or function of a pickle, by its full name; it is never looked up."""

    name: str


@dataclass
class PickledObject:
    """Object of a pickle as its parts; ``name`` was not called with ``args``."""

    name: str
    args: tuple[Any, ...]
    state: Any = None


@dataclass(frozen=True)
class PickledAction:
    """One action of a chunk, at its step."""

    timestamp: float
    timestep: int
    values: tuple[float, ...]


def pickled(name: str, state: Mapping[str, Any]) -> bytes:
    """Return the pickle of an object of LeRobot's class ``name``.

    Args:
        name: of a class of :data:`HELPERS`; it need not be installed here.
        state: its attributes: numbers, text, arrays, and lists and maps of them.
    """
    # Protocol 3 has bytes and no frames, so what is between its first two bytes and its last can be put inside another.
    inner = pickle.dumps(dict(state), protocol=3)[2:-1]
    return b"\x80\x03c" + f"{HELPERS}\n{name}\n".encode() + b")\x81" + inner + b"b."


def read_actions(data: bytes) -> list[PickledAction]:
    """Return the actions of an answer.

    Raises:
        UnreadablePickleError: anything else than a list of actions whose numbers are a flat tensor of float32 or
            float64.
    """
    if len(data) > ANSWER_MAX:
        raise UnreadablePickleError(f"it has {len(data):,} bytes, and may have {ANSWER_MAX:,}")
    # All actions are counted together: one piece of bytes may stand for many of them.
    left = _Left()
    answer = _read(io.BytesIO(data), left)
    if not isinstance(answer, list):
        raise UnreadablePickleError(f"a list of actions was expected, not {_shown(answer)}")
    return [_action(each, left) for each in answer]


@dataclass
class _Left:
    """Operations and numbers that the rest of an answer may have."""

    operations: int = OPERATIONS_MAX
    numbers: int = NUMBERS_MAX

    def take_operations(self, count: int = 1) -> None:
        self.operations -= count
        if self.operations < 0:
            raise UnreadablePickleError(f"it has more than {OPERATIONS_MAX:,} operations")

    def take_numbers(self, count: int) -> None:
        self.numbers -= count
        if self.numbers < 0:
            raise UnreadablePickleError(f"it has more than {NUMBERS_MAX:,} numbers")


def _read(stream: BinaryIO, left: _Left) -> Any:
    """Return the next pickle of a stream as lists, maps and objects.

    Raises:
        UnreadablePickleError: an operation or a name that is not read here, more operations than are left, or a pickle
            that is cut off or malformed.
    """
    reader = _Reader(left)
    try:
        for opcode, argument, _ in pickletools.genops(stream):
            if opcode.name == "STOP":
                return reader.result()
            reader.take(opcode.name, argument)
    except UnreadablePickleError:
        raise
    except (ValueError, TypeError, KeyError, IndexError, AttributeError, OverflowError, RecursionError) as exc:
        raise UnreadablePickleError(f"it is malformed: {type(exc).__name__}: {exc!s:.200}") from None
    raise UnreadablePickleError("it is cut off")


class _Reader:
    """Stack and memo of one pickle."""

    def __init__(self, left: _Left) -> None:
        self._left = left
        self._stack: list[Any] = []
        self._marks: list[int] = []
        self._memo: dict[int, Any] = {}

    def take(self, name: str, argument: Any) -> None:
        self._left.take_operations()
        if name in _VALUES:
            self._stack.append(argument)
            return
        step = _STEPS.get(name)
        if step is None:
            raise UnreadablePickleError(f"the operation {name} is not read")
        step(self, argument)

    def result(self) -> Any:
        (result,) = self._stack
        return result

    def push_name(self, full: str) -> None:
        # A name takes as long as four operations.
        self._left.take_operations(3)
        if full not in _NAMES:
            raise UnreadablePickleError(f"it names {shown(full)}, which is not read")
        self._stack.append(PickledName(full))

    def name_of_stack(self) -> None:
        name, module = self._stack.pop(), self._stack.pop()
        # The text of a tuple of tuples could take for ever to write.
        if not (_is_text(name) and _is_text(module)):
            raise UnreadablePickleError("a name must be text")
        self.push_name(f"{module}.{name}")

    def remember(self, index: int | None = None) -> None:
        self._memo[len(self._memo) if index is None else index] = self._stack[-1]

    def recall(self, index: int) -> None:
        self._stack.append(self._memo[index])

    def tuple_of(self, count: int) -> None:
        if len(self._stack) < count:
            raise UnreadablePickleError("a tuple lacks items")
        items = tuple(self._stack[len(self._stack) - count :])
        del self._stack[len(self._stack) - count :]
        self._stack.append(items)

    def mark(self) -> None:
        self._marks.append(len(self._stack))

    def since_mark(self) -> list[Any]:
        at = self._marks.pop()
        items = self._stack[at:]
        del self._stack[at:]
        return items

    def append(self, items: Sequence[Any]) -> None:
        if not isinstance(self._stack[-1], list):
            raise UnreadablePickleError("items without a list")
        self._stack[-1].extend(items)

    def set_items(self, items: Sequence[Any]) -> None:
        target, keys = self._stack[-1], items[::2]
        # A key that is a tuple of tuples could take for ever to hash.
        if not isinstance(target, dict) or len(items) % 2 or not all(isinstance(key, str) for key in keys):
            raise UnreadablePickleError("a map must have text as keys")
        target.update(zip(keys, items[1::2], strict=True))

    def make(self) -> None:
        args, callable_ = self._stack.pop(), self._stack.pop()
        if not isinstance(callable_, PickledName) or not isinstance(args, tuple):
            raise UnreadablePickleError("a call of something that is no listed name")
        self._stack.append(PickledObject(callable_.name, args))

    def build(self) -> None:
        state, target = self._stack.pop(), self._stack[-1]
        if not isinstance(target, PickledObject) or target.state is not None:
            raise UnreadablePickleError("attributes of something that is no new object")
        target.state = state

    def stored(self) -> None:
        self._stack.append(PickledObject("stored", _tuple(self._stack.pop())))


_VALUES = frozenset(
    {"BININT", "BININT1", "BININT2", "LONG1", "BINFLOAT"}
    | {"BINUNICODE", "SHORT_BINUNICODE", "BINBYTES", "SHORT_BINBYTES"}
)
_STEPS: dict[str, Callable[[_Reader, Any], None]] = {
    "PROTO": lambda reader, _: None,
    "FRAME": lambda reader, _: None,
    "NONE": lambda reader, _: reader._stack.append(None),
    "NEWTRUE": lambda reader, _: reader._stack.append(True),
    "NEWFALSE": lambda reader, _: reader._stack.append(False),
    "EMPTY_LIST": lambda reader, _: reader._stack.append([]),
    "EMPTY_DICT": lambda reader, _: reader._stack.append({}),
    "EMPTY_TUPLE": lambda reader, _: reader._stack.append(()),
    "MARK": lambda reader, _: reader.mark(),
    "GLOBAL": lambda reader, name: reader.push_name(str(name).replace(" ", ".", 1)),
    "STACK_GLOBAL": lambda reader, _: reader.name_of_stack(),
    "MEMOIZE": lambda reader, _: reader.remember(),
    "BINPUT": lambda reader, index: reader.remember(index),
    "LONG_BINPUT": lambda reader, index: reader.remember(index),
    "BINGET": lambda reader, index: reader.recall(index),
    "LONG_BINGET": lambda reader, index: reader.recall(index),
    "TUPLE1": lambda reader, _: reader.tuple_of(1),
    "TUPLE2": lambda reader, _: reader.tuple_of(2),
    "TUPLE3": lambda reader, _: reader.tuple_of(3),
    "TUPLE": lambda reader, _: reader._stack.append(tuple(reader.since_mark())),
    "APPEND": lambda reader, _: reader.append([reader._stack.pop()]),
    "APPENDS": lambda reader, _: reader.append(reader.since_mark()),
    "SETITEM": lambda reader, _: reader.set_items([reader._stack.pop(-2), reader._stack.pop()]),
    "SETITEMS": lambda reader, _: reader.set_items(reader.since_mark()),
    "NEWOBJ": lambda reader, _: reader.make(),
    "REDUCE": lambda reader, _: reader.make(),
    "BUILD": lambda reader, _: reader.build(),
    "BINPERSID": lambda reader, _: reader.stored(),
}
"""Operations by name; all others end the reading."""


def _action(found: Any, left: _Left) -> PickledAction:
    if not isinstance(found, PickledObject) or found.name != _ACTION or not isinstance(found.state, dict):
        raise UnreadablePickleError(f"an action was expected, not {_shown(found)}")
    timestamp, timestep = found.state.get("timestamp"), found.state.get("timestep")
    if type(timestamp) is not float or type(timestep) is not int:
        raise UnreadablePickleError(f"an action has the step {_shown(timestep)} at {_shown(timestamp)}")
    return PickledAction(timestamp, timestep, _tensor(found.state.get("action"), left))


def _tensor(found: Any, left: _Left) -> tuple[float, ...]:
    """Return the numbers of a flat tensor."""
    if not isinstance(found, PickledObject) or found.name != _TENSOR or len(found.args) < 4:
        raise UnreadablePickleError(f"an action must be a tensor, not {_shown(found)}")
    storage, offset, size, stride = found.args[:4]
    if not isinstance(storage, PickledObject) or storage.name != _STORAGE or len(storage.args) != 1:
        raise UnreadablePickleError("a tensor must have its numbers as bytes")
    kind, numbers = _storage(storage.args[0], left)
    if not (_flat(size) and _flat(stride) and _is_count(offset) and 1 <= size[0] <= SIZE_MAX and stride[0] == 1):
        raise UnreadablePickleError(f"an action must be a flat tensor, not one of the size {_shown(size)}")
    code, width = kind
    first, last = offset * width, (offset + size[0]) * width
    if last > len(numbers):
        raise UnreadablePickleError("a tensor has more numbers than its bytes")
    # One action may stand in the list many times, and each time its numbers are copied.
    left.take_numbers(size[0])
    return struct.unpack(f"<{size[0]}{code}", numbers[first:last])


def _storage(data: Any, left: _Left) -> tuple[tuple[str, int], memoryview]:
    """Return the kind and the bytes of the numbers in a file of torch's older format."""
    if not isinstance(data, bytes):
        raise UnreadablePickleError("a tensor must have its numbers as bytes")
    stream = io.BytesIO(memoryview(data)[:HEADER_MAX])
    magic, version, _ = (_read(stream, left) for _ in range(3))
    if type(magic) is not int or type(version) is not int or (magic, version) != (_MAGIC, _VERSION):
        raise UnreadablePickleError("a tensor's file is of another format")
    stored, keys = _read(stream, left), _read(stream, left)
    parts = stored.args if isinstance(stored, PickledObject) and stored.name == "stored" else ()
    kind = parts[1].name if len(parts) >= 5 and isinstance(parts[1], PickledName) else ""
    if kind not in _KINDS or not _is_text(parts[0]) or parts[0] != "storage" or not _is_count(parts[4]):
        raise UnreadablePickleError(f"a tensor must have float32 or float64 numbers, not {_shown(kind or parts)}")
    # Two tuples of tuples could take for ever to compare.
    key = parts[2]
    if not (_is_text(key) and isinstance(keys, list) and len(keys) == 1 and _is_text(keys[0]) and keys[0] == key):
        raise UnreadablePickleError("a tensor's file must have one storage, under its key")
    numbers = memoryview(data)[stream.tell() + 8 :]
    (count,) = struct.unpack("<q", data[stream.tell() : stream.tell() + 8].ljust(8, b"\xff"))
    if count != parts[4] or count * _KINDS[kind][1] != len(numbers):
        raise UnreadablePickleError("a tensor's bytes are not as many as it says")
    return _KINDS[kind], numbers


def _tuple(value: Any) -> tuple[Any, ...]:
    if not isinstance(value, tuple):
        raise UnreadablePickleError("a reference must be a tuple")
    return value


def _flat(value: Any) -> bool:
    return isinstance(value, tuple) and len(value) == 1 and _is_count(value[0])


def _is_text(value: Any) -> bool:
    return type(value) is str


def _is_count(value: Any) -> bool:
    return type(value) is int and 0 <= value < 2**31


def _shown(value: Any) -> str:
    """Return a value for an error; what is nested only by its kind."""
    plain = value is None or isinstance(value, str | bytes | int | float)
    return shown(value) if plain else getattr(value, "name", "") or f"a {type(value).__name__}"


_module = partial(optional_module, what="The lerobot_async policy", extra="lerobot-async")

PORT = 8080
SERVICE = "/transport.AsyncInference/"
PIECE = 2 * 2**20
"""Longest piece of an observation, in bytes; gRPC servers refuse messages of 4 MB."""

CHUNK = 100
"""Actions that are asked for where the profile states no ``chunk``."""

TASK = "task"

_BEGIN, _MIDDLE, _END = 1, 2, 3
_serving: dict[str, LeRobotAsyncConnection] = {}
_serving_lock = threading.Lock()


class LeRobotAsyncConnection:
    """One channel to a server, which serves no other policy meanwhile.

    Raises:
        PolicyServerError: another policy of this process uses the server.
    """

    def __init__(self, profile: Profile) -> None:
        self._url = profile.url
        self._profile = profile.name
        self._steps = itertools.count()
        self.lost = False
        """True when an answer failed: the server may be another one by now, or have loaded another policy."""
        self._channel: Any = None
        with _serving_lock:
            other = _serving.setdefault(self._url, self)
        if other is not self:
            raise PolicyServerError(
                f"the policy server at {self._url} is in use by the profile {other._profile}; it serves one robot at "
                "a time"
            )

    def instruct(self, instructions: bytes, deadline: float) -> None:
        """Have the server load a policy.

        Raises:
            PolicyServerError: it does not answer, or cannot load it.
        """
        never = threading.Event()
        self._call("Ready", b"", deadline, never)
        self._call("SendPolicyInstructions", _field(1, instructions), deadline, never)

    def infer(self, observation: Mapping[str, Any], deadline: float, interrupted: threading.Event) -> Any:
        """Return the actions of an observation, which is sent as the next step.

        Raises:
            PolicyServerError: no answer in time, none at all, one that cannot be read, or one of another observation.
        """
        step, now = next(self._steps), time.time()
        # Without must_go an observation whose joints have hardly moved is dropped, and nothing is answered.
        state = {"timestamp": now, "timestep": step, "observation": dict(observation), "must_go": True}
        self._call("SendObservations", _pieces(pickled("TimedObservation", state)), deadline, interrupted)
        answer = self._call("GetActions", b"", deadline, interrupted)
        where = f"the policy server at {self._url}"
        if not answer:
            raise PolicyServerError(f"{where} answered no actions; why is in its own log alone")
        try:
            actions = read_actions(answer)
        except UnreadablePickleError as exc:
            raise PolicyServerError(f"{where} sent an unreadable answer: {exc}") from exc
        # Every client counts from 0; the server gives the first action the time of its observation.
        steps = [each.timestep for each in actions]
        if steps != list(range(step, step + len(steps))) or any(each.timestamp != now for each in actions[:1]):
            raise PolicyServerError(f"{where} answered another observation; it serves another client besides")
        return [each.values for each in actions]

    def close(self) -> None:
        """Drop the channel and leave the server to others."""
        with _serving_lock:
            if _serving.get(self._url) is self:
                del _serving[self._url]
        channel, self._channel = self._channel, None
        if channel is not None:
            channel.close()

    def _call(self, method: str, message: Any, deadline: float, interrupted: threading.Event) -> bytes:
        """Return the bytes of an answer's only field; empty where it has none.

        Args:
            message: bytes, or an iterator of them.
        """
        grpc = _module("grpc")
        channel = self._open()
        kind = channel.unary_unary if isinstance(message, bytes) else channel.stream_unary
        call = kind(SERVICE + method).future(message, timeout=max(0.01, deadline - time.monotonic()))

        def receive(seconds: float) -> Any:
            try:
                return call.result(timeout=seconds)
            except grpc.FutureTimeoutError:
                raise TimeoutError from None

        try:
            answer: bytes = wait_for_answer(self._url, receive, deadline, interrupted, call.cancel)
        except grpc.RpcError as exc:
            raise PolicyServerError(self._failure(method, exc)) from exc
        return _first_field(answer)

    def _failure(self, method: str, exc: Any) -> str:
        code = exc.code().name
        if code == "DEADLINE_EXCEEDED":
            return f"the policy server at {self._url} did not answer in time"
        if code == "UNAVAILABLE":
            return f"no policy server answers at {self._url}: {shown(exc.details())}"
        return f"the policy server at {self._url} failed in {method}: {code}, {shown(exc.details())}"

    def _open(self) -> Any:
        if self._channel is None:
            address = urlsplit(self._url)
            host = f"[{address.hostname}]" if ":" in str(address.hostname) else address.hostname
            # An answer that claims to be packed is handed on as it is, and refused: it might unpack to gigabytes.
            options = [
                ("grpc.max_receive_message_length", ANSWER_MAX),
                ("grpc.per_message_decompression", 0),
                ("grpc.enable_http_proxy", 0),
            ]
            target = f"{host}:{address.port or PORT}"
            self._channel = _module("grpc").insecure_channel(target, options=options)
        return self._channel


class LeRobotAsyncPolicy(ServedPolicy):
    """Policy on LeRobot's async server, which loads what the profile says.

    Raises:
        ValidationError: also a server that is neither here nor behind a tunnel, an environment, or one name for two
            things.
    """

    provider = "lerobot_async"
    connections = PreloadedModels()

    def __init__(self, profile: Profile | None = None) -> None:
        super().__init__(profile)
        where = f"profile {self.profile.name}"
        address = urlsplit(self.profile.url)
        if address.scheme != "grpc" or not is_loopback_host(str(address.hostname)):
            raise ValidationError(
                f"{where}: url must be grpc:// on this machine, not {shown(self.profile.url)}: the server runs what "
                "anyone sends it. Reach one elsewhere by a tunnel, ssh -L 8080:127.0.0.1:8080."
            )
        if self.profile.environment:
            raise ValidationError(f"{where}: a server of LeRobot's takes no environment.")
        names = [*self.profile.state, *(each.short_key for each in self.profile.cameras), TASK]
        if twice := sorted({name for name in names if names.count(name) > 1}):
            raise ValidationError(f"{where}: state and cameras must have names of their own, not {', '.join(twice)}.")
        for module in ("grpc", "numpy"):
            _module(module)

    def connect(self, token: str, deadline: float) -> LeRobotAsyncConnection:
        connection = LeRobotAsyncConnection(self.profile)
        try:
            connection.instruct(self._instructions(), deadline)
        except BaseException:
            connection.close()
            raise
        return connection

    def observation(self, seen: Mapping[str, Any], task: str) -> dict[str, Any]:
        numpy, profile = _module("numpy"), self.profile
        pictures = {each.short_key: numpy.ascontiguousarray(seen[each.short_key]) for each in profile.cameras}
        return {**{key: float(seen[key]) for key in profile.state}, **pictures, TASK: task}

    def actions(self, answer: Any) -> list[Action]:
        chunk = self.profile.chunk
        if chunk is not None:
            compare("chunk", len(answer), chunk)
        if len({len(row) for row in answer}) != 1:
            raise PolicyServerError("the server answered actions of different lengths, or none")
        return actions_of(answer, self.profile.action)

    def act(self, observation: Mapping[str, Any]) -> list[Action]:
        try:
            return super().act(observation)
        except PolicyServerError:
            if isinstance(self._connection, LeRobotAsyncConnection):
                self._connection.lost = not self._interrupted.is_set()
            raise

    def close(self) -> None:
        """Leave the connection to the next task; a late answer went with its own call."""
        connection, self._connection = self._connection, None
        if isinstance(connection, LeRobotAsyncConnection) and connection.lost:
            connection.close()
        elif connection is not None:
            self.connections.give(self._key, connection)

    def _instructions(self) -> bytes:
        """Return what the server is to load, and how an observation becomes its features."""
        profile = self.profile
        names = list(profile.state)
        features: dict[str, Any] = {STATE: {"dtype": "float32", "shape": (len(names),), "names": names}}
        for camera in profile.cameras:
            size = (*(camera.size or (0, 0)), 3)
            axes = ["height", "width", "channels"]
            features[IMAGES + camera.short_key] = {"dtype": "image", "shape": size, "names": axes}
        state = {
            "policy_type": profile.policy_type,
            "pretrained_name_or_path": profile.checkpoint,
            "lerobot_features": features,
            "actions_per_chunk": profile.chunk or profile.horizon or CHUNK,
            "device": profile.device or "cpu",
            # The server renames after it has resized, so a renamed picture fails there; the profile's key is sent.
            "rename_map": {},
        }
        return pickled("RemotePolicyConfig", state)


def _field(number: int, value: bytes) -> bytes:
    """Return a field of bytes, as protobuf has it."""
    return bytes([number << 3 | 2]) + _varint(len(value)) + value


def _pieces(data: bytes) -> Iterator[bytes]:
    """Yield the messages of an observation: where it is of the whole, and its bytes."""
    for start in range(0, len(data), PIECE):
        place = _END if start + PIECE >= len(data) else _BEGIN if start == 0 else _MIDDLE
        yield bytes([1 << 3, place]) + _field(2, data[start : start + PIECE])


def _varint(value: int) -> bytes:
    made = bytearray()
    while value > 0x7F:
        made.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*made, value])


def _first_field(message: bytes) -> bytes:
    """Return the bytes of field 1, the only one; empty where there is none.

    Raises:
        PolicyServerError: another message.
    """
    if not message:
        return b""
    length, shift, at = 0, 0, 1
    while at < len(message) and shift < 35:
        length |= (message[at] & 0x7F) << shift
        shift, at = shift + 7, at + 1
        if not message[at - 1] & 0x80:
            break
    if message[0] != (1 << 3 | 2) or len(message) - at != length:
        raise PolicyServerError("the policy server sent a message that is none of LeRobot's")
    return message[at:]
