"""Client of a policy server of Isaac GR00T: MessagePack over ZeroMQ, REQ and REP.

ZeroMQ's own library bounds each part of a message and not their number, so a server could fill the memory. Here an
answer is bounded as a whole. Wire: ZMTP 3.0 (ZeroMQ RFC 23) with the mechanism NULL and the socket type REQ: a greeting
and a READY command from either side, then each message as an empty frame and its body.

A question is ``{endpoint, data, api_token}``. An array is ``{__ndarray_class__: true, as_npy: bytes}`` in numpy's own
format, and an error ``{error: text}``. N1.5 takes a flat observation without a batch axis; N1.6 and N1.7 take maps
``video``, ``state`` and ``language`` with one, or, behind their wrapper for simulations, flat keys with one. Source:
Isaac-GR00T, ``gr00t/eval/service.py`` (N1.5) and ``gr00t/policy/server_client.py`` (N1.6, N1.7).

There are no ids: after a missed answer the connection is closed and another one opened. Nothing is encrypted: use
loopback or a tunnel.
"""

from __future__ import annotations

import contextlib
import io
import re
import socket
import struct
import threading
import time
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any
from urllib.parse import urlsplit

from strands_robots.errors import StrandsRobotsError
from strands_robots.policies.base import Action
from strands_robots.policies.decoding import MESSAGE_MAX, ForeignDataError, decode_json, decode_msgpack
from strands_robots.policies.policy_server import (
    PolicyServerError,
    ServedPolicy,
    actions_of,
    checked_chunk,
    compare,
    numbers_of,
    wait_for_answer,
)
from strands_robots.policies.preload import PreloadedModels
from strands_robots.policies.profiles import Profile
from strands_robots.utils import ValidationError, optional_module, shown

_GREETING = b"\xff" + bytes(8) + b"\x7f\x03\x00" + b"NULL".ljust(20, b"\0") + bytes(32)
_VERSION = 10
"""Place of the version in a greeting, behind the signature."""
_READY = b"\x05READY\x0bSocket-Type\x00\x00\x00\x03REQ"
_PING, _PONG = b"\x04PING", b"\x04PONG"
_MORE, _LONG, _COMMAND = 1, 2, 4
_COMMAND_MAX = 4096
_PIECE = 64 * 1024


class ZmtpError(StrandsRobotsError):
    """The server speaks something else, or its answer is too long."""


class RequestSocket:
    """Connection that is opened with the first request; used by one thread at a time.

    Args:
        url: ``tcp://HOST:PORT``.
        answer_max: longest answer, in bytes.
    """

    def __init__(self, url: str, answer_max: int) -> None:
        self._url = url
        self._answer_max = answer_max
        self._socket: socket.socket | None = None
        self._received = bytearray()
        self._delimited = False

    def send(self, body: bytes, deadline: float) -> None:
        """Send a request; ``deadline`` in monotonic seconds.

        Raises:
            OSError: no server is there, or it does not read in time.
        """
        if self._socket is None:
            self._open(deadline)
        self._write(_frame(_MORE, b"") + _frame(0, body), deadline)

    def receive(self, seconds: float) -> bytes:
        """Return the answer.

        Raises:
            TimeoutError: it is not whole in time; another call goes on with it.
            OSError: the connection was lost.
            ZmtpError: the answer is longer than it may be, or none of ZeroMQ's.
        """
        deadline = time.monotonic() + seconds
        while True:
            flags, body = self._next_frame(deadline)
            if flags & _COMMAND:
                if body.startswith(_PING):
                    # Behind the name come two bytes of a lifetime, and a context to be sent back.
                    self._write(_frame(_COMMAND, _PONG + body[len(_PING) + 2 :]), deadline)
            elif not flags & _MORE:
                self._delimited = False
                return body
            elif body or self._delimited:
                raise ZmtpError("it sent an answer of several parts")
            else:
                self._delimited = True

    def close(self) -> None:
        """Drop the connection; a late answer goes with it."""
        opened, self._socket = self._socket, None
        self._received.clear()
        self._delimited = False
        if opened is not None:
            with contextlib.suppress(OSError):  # it is lost already
                opened.close()

    def _open(self, deadline: float) -> None:
        address = urlsplit(self._url)
        self._socket = socket.create_connection((str(address.hostname), address.port or 0), _left(deadline))
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._write(_GREETING, deadline)
        self._fill(len(_GREETING), deadline)
        greeting = self._taken(len(_GREETING))
        if greeting[0] != 0xFF or not greeting[_VERSION - 1] & 1 or greeting[_VERSION] < 3:
            raise ZmtpError("it speaks no ZMTP 3")
        self._write(_frame(_COMMAND, _READY), deadline)
        # A message before the server's own READY would end the connection.
        flags, body = self._next_frame(deadline)
        if not flags & _COMMAND or not body.startswith(_READY[:6]):
            raise ZmtpError("it is not ready")

    def _next_frame(self, deadline: float) -> tuple[int, bytes]:
        """Return the flags and the body of the next frame, once it is whole."""
        self._fill(2, deadline)
        flags, length, start = self._received[0], self._received[1], 2
        if flags & _LONG:
            start = 9
            self._fill(start, deadline)
            (length,) = struct.unpack_from(">Q", self._received, 1)
        most = _COMMAND_MAX if flags & _COMMAND else self._answer_max
        if length > most:
            raise ZmtpError(f"it sent {length:,} bytes, and may send {most:,}")
        self._fill(start + length, deadline)
        return flags, self._taken(start + length)[start:]

    def _fill(self, size: int, deadline: float) -> None:
        """Read until so many bytes wait; what came in time stays for the next call."""
        assert self._socket is not None
        while len(self._received) < size:
            if time.monotonic() > deadline:
                raise TimeoutError("it did not answer in time")
            self._socket.settimeout(_left(deadline))
            data = self._socket.recv(_PIECE)
            if not data:
                raise ConnectionResetError("it hung up")
            self._received += data

    def _taken(self, size: int) -> bytes:
        taken = bytes(memoryview(self._received)[:size])
        del self._received[:size]
        return taken

    def _write(self, data: bytes, deadline: float) -> None:
        assert self._socket is not None
        self._socket.settimeout(_left(deadline))
        self._socket.sendall(data)


def _frame(flags: int, body: bytes) -> bytes:
    if len(body) > 255:
        return bytes([flags | _LONG]) + struct.pack(">Q", len(body)) + body
    return bytes([flags, len(body)]) + body


def _left(deadline: float) -> float:
    return max(0.001, deadline - time.monotonic())


_module = partial(optional_module, what="The groot policy", extra="groot")

LAYOUTS = ("n1.6", "n1.6-flat", "n1.5")
LANGUAGE = "annotation.human.task_description"
"""Key of the instruction where the server states none."""

_HEADER = re.compile(
    rb"\x93NUMPY[\1-\3]\0..(?:\0\0)?"
    rb"\{'descr': '([<>|=][biuf][1248])', 'fortran_order': (True|False), 'shape': \(([0-9, ]{0,100})\), \} *\n",
    re.DOTALL,
)
"""Header of an array of plain numbers as numpy writes it. Source: NEP 1."""


class GrootConnection:
    """One ZeroMQ socket to a server; used by one policy at a time."""

    def __init__(self, url: str, token: str) -> None:
        self._url = url
        self._token = token
        self._socket = RequestSocket(url, MESSAGE_MAX)
        self.language = LANGUAGE

    def infer(self, observation: Any, deadline: float, interrupted: threading.Event) -> Any:
        return self.ask("get_action", observation, deadline, interrupted)

    def ask(self, endpoint: str, data: Any, deadline: float, interrupted: threading.Event) -> Any:
        """Return the answer of an endpoint; ``data`` None asks without any.

        Raises:
            PolicyServerError: no answer in time, one that cannot be read, or the server's error.
        """
        question: dict[str, Any] = {"endpoint": endpoint}
        if data is not None:
            question["data"] = data
        if self._token:
            question["api_token"] = self._token
        frame = _module("msgpack").packb(question, default=_encoded)
        try:
            try:
                answer = self._asked(frame, deadline, interrupted)
            except OSError:
                # The server may have been started anew.
                self.close()
                answer = self._asked(frame, deadline, interrupted)
        except (OSError, ZmtpError) as exc:
            self.close()
            raise PolicyServerError(f"no policy server answers at {self._url}: {exc}") from exc
        return self.read(answer)

    def _asked(self, frame: bytes, deadline: float, interrupted: threading.Event) -> bytes:
        self._socket.send(frame, deadline)
        answer: bytes = wait_for_answer(self._url, self._socket.receive, deadline, interrupted, self.close)
        return answer

    def read(self, frame: bytes) -> Any:
        """Return what an answer holds.

        Raises:
            PolicyServerError: it cannot be read, or is the server's error.
        """
        try:
            answer = decode_msgpack(frame)
        except ForeignDataError as exc:
            raise PolicyServerError(f"the policy server at {self._url} sent an unreadable answer: {exc}") from exc
        if isinstance(answer, Mapping) and "error" in answer:
            raise PolicyServerError(f"the policy server at {self._url} failed: {shown(answer['error'])}")
        return answer

    def close(self) -> None:
        """Drop the connection; a late answer goes with it."""
        self._socket.close()


class GrootPolicy(ServedPolicy):
    """Policy on a GR00T server; the profile's ``parts`` name the keys of each part.

    Raises:
        ValidationError: also parts that lack a key of ``state`` or ``action``, or name one twice.
    """

    provider = "groot"
    connections = PreloadedModels()

    def __init__(self, profile: Profile | None = None) -> None:
        super().__init__(profile)
        self._layout = self.layout(LAYOUTS)
        self._language = LANGUAGE
        self._state = _parts_of(self.profile, "state", self.profile.state)
        self._action = _parts_of(self.profile, "action", self.profile.action)
        for module in ("msgpack", "numpy"):
            _module(module)

    def connect(self, token: str, deadline: float) -> GrootConnection:
        connection = GrootConnection(self.profile.url, token)
        try:
            self._compare(connection, connection.ask("get_modality_config", None, deadline, threading.Event()))
        except BaseException:
            connection.close()
            raise
        return connection

    def observation(self, seen: Mapping[str, Any], task: str) -> dict[str, Any]:
        numpy, nested = _module("numpy"), self._layout == "n1.6"
        # History of one: time before height or number, and the batch before time.
        axes = (None,) if self._layout == "n1.5" else (None, None)
        kind = numpy.float64 if self._layout == "n1.5" else numpy.float32
        video = {each.short_key: numpy.asarray(seen[each.short_key])[axes] for each in self.profile.cameras}
        state = {part: numpy.array([seen[key] for key in keys], kind)[axes] for part, keys in self._state.items()}
        if nested:
            request: dict[str, Any] = {"video": video, "state": state, "language": {self._language: [[task]]}}
        else:
            request = {f"video.{name}": each for name, each in video.items()}
            request |= {f"state.{name}": each for name, each in state.items()}
            request[self._language] = [task]
        return request if self._layout == "n1.5" else {"observation": request, "options": None}

    def actions(self, answer: Any) -> list[Action]:
        if isinstance(answer, Sequence) and not isinstance(answer, str | bytes) and answer:
            answer = answer[0]
        if not isinstance(answer, Mapping):
            raise PolicyServerError(f"the server at {self.profile.url} answered without actions: {shown(answer)}")
        given = {str(part).removeprefix("action."): each for part, each in answer.items()}
        if missing := sorted(self._action.keys() - given.keys()):
            raise PolicyServerError(f"the server answered no {', '.join(missing)}; it has {shown(sorted(given))}")
        numpy, chunks = _module("numpy"), {}
        for part, keys in self._action.items():
            chunk = _array(given[part])
            if chunk.ndim == 3 and chunk.shape[0] == 1:
                chunk = chunk[0]
            chunk = chunk[:, None] if chunk.ndim == 1 and len(keys) == 1 else chunk
            chunks[part] = checked_chunk(chunk, len(keys))
        lengths = {part: len(each) for part, each in chunks.items()}
        if len(set(lengths.values())) != 1:
            raise PolicyServerError(f"the server answered parts of different lengths: {lengths}")
        together = [key for keys in self._action.values() for key in keys]
        order = [together.index(key) for key in self.profile.action]
        return actions_of(numpy.concatenate(list(chunks.values()), axis=1)[:, order], self.profile.action)

    def begin(self, connection: Any) -> None:
        self._language = connection.language
        if self._layout != "n1.5":
            deadline = time.monotonic() + self.profile.deadline_s
            connection.ask("reset", {"options": None}, deadline, self._interrupted)

    def _compare(self, connection: GrootConnection, config: Any) -> None:
        """Compare the server's modalities with the profile.

        Raises:
            PolicyServerError: other cameras, parts or horizon, or frames of the past, which this client does not keep.
        """
        profile = self.profile
        wanted = {
            "video": [each.short_key for each in profile.cameras],
            "state": list(self._state),
            "action": list(self._action),
        }
        for modality, mine in wanted.items():
            names, deltas = _modality(config, modality)
            if names is not None:
                compare(f"modality {modality}", sorted(names), sorted(mine))
            if modality == "action":
                if deltas is not None and profile.chunk is not None:
                    compare("horizon", len(deltas), profile.chunk)
            elif deltas not in (None, [0]):
                raise PolicyServerError(
                    f"the server wants {modality} of the steps {shown(deltas)}, and gets the present alone"
                )
        names, _ = _modality(config, "language")
        self._language = connection.language = names[0] if names else LANGUAGE


def _modality(config: Any, modality: str) -> tuple[list[str] | None, list[int] | None]:
    """Return the keys and the steps of a modality, None where none are stated."""
    stated = config.get(modality) if isinstance(config, Mapping) else None
    if isinstance(stated, Mapping) and "__ModalityConfig_class__" in stated:
        stated = stated.get("as_json", stated.get("as_dict"))
        try:
            stated = decode_json(stated) if isinstance(stated, str) else stated
        except ForeignDataError as exc:
            raise PolicyServerError(f"the server's modality {modality} cannot be read: {exc}") from exc
    if not isinstance(stated, Mapping):
        return None, None
    names, deltas = stated.get("modality_keys"), stated.get("delta_indices")
    plain = modality + "." if modality != "language" else ""
    return (
        [str(name).removeprefix(plain) for name in names] if isinstance(names, list) else None,
        deltas if isinstance(deltas, list) else None,
    )


def _parts_of(profile: Profile, name: str, wanted: tuple[str, ...]) -> dict[str, tuple[str, ...]]:
    """Return the parts that have the keys of state or action.

    Raises:
        ValidationError: a key in no part or in two, or a part of which only some keys are in it.
    """
    where = f"profile {profile.name}: parts"
    found = {part: keys for part, keys in profile.parts.items() if set(keys) & set(wanted)}
    for part, keys in found.items():
        if strange := [key for key in keys if key not in wanted]:
            raise ValidationError(f"{where}.{part} has {', '.join(strange)}, which {name} lacks.")
    named = [key for each in found.values() for key in each]
    if sorted(named) != sorted(wanted):
        raise ValidationError(f"{where} must name each key of {name} once, {', '.join(wanted)}, not {shown(named)}.")
    return found


def _encoded(value: Any) -> Any:
    """Return an array as GR00T's map."""
    numpy = _module("numpy")
    if not isinstance(value, numpy.ndarray):
        raise TypeError(f"an observation cannot have {shown(value)}")
    file = io.BytesIO()
    numpy.save(file, value, allow_pickle=False)
    return {"__ndarray_class__": True, "as_npy": file.getvalue()}


def _array(found: Any) -> Any:
    """Decode an array in numpy's own format without a copy, or lists of numbers.

    ``numpy.load`` also opens archives, evaluates the header, and makes room for whatever shape it states.

    Raises:
        PolicyServerError: no such array, an array of objects, or one whose bytes do not fill its shape.
    """
    if not (isinstance(found, Mapping) and "__ndarray_class__" in found):
        return numbers_of(found)
    file = found.get("as_npy")
    header = _HEADER.match(file) if isinstance(file, bytes) else None
    if header is None or not isinstance(file, bytes):
        raise PolicyServerError(f"the policy server sent an array that cannot be read: {shown(file)}")
    dtype, fortran, shape = (each.decode() for each in header.groups())
    try:
        lengths = tuple(int(each) for each in shape.split(",") if each.strip())
        flat = _module("numpy").frombuffer(file, dtype, offset=header.end())
        return flat.reshape(lengths, order="F" if fortran == "True" else "C")
    except (ValueError, TypeError) as exc:
        raise PolicyServerError(f"the policy server sent an array that cannot be read: {exc!s:.200}") from exc
