"""Keys of robots and consoles, and the public keys enrolled here.

A robot makes its Ed25519 key at its first start, in the state directory of its machine. Whoever asks robots keeps the
public keys that an operator enrolled, in the state directory of the asking machine. Both are private files: a key that
another user owns, may read or may write proves nothing, so it is refused by name.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import os
import secrets
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

from strands_robots import settings
from strands_robots.errors import StrandsRobotsError
from strands_robots.safety import ed25519
from strands_robots.safety.network_key import NetworkKey
from strands_robots.state_files import (
    OPEN,
    StateFileError,
    make_private,
    read_private,
    require_private,
    state_dir,
    write_private,
)
from strands_robots.stop_log import stop_logger
from strands_robots.utils import field_values, identifier

logger = stop_logger(__name__)

T = TypeVar("T")

ROBOTS = "robots"
"""Folder of the keys of robots; a console's keys have a folder of their own."""

DEFAULT_TENANT = "default"

VERSION = 1
FILE_MAX_BYTES = 2**20
SEED_BYTES = 32

RETIRED, OFF = "retired", "off"
EXEMPT_STATES = (RETIRED, OFF)

NETWORKS_MAX = 8

LOCK_S = 2.0
"""Seconds that a change of the enrolled robots waits for another process."""


class KeyFileError(StateFileError):
    """A key file that cannot be trusted; the message names it and says why."""


class KeyChangedError(StrandsRobotsError, ValueError):
    """A robot shows another key than the one enrolled for it."""


def fingerprint(public: bytes) -> str:
    """Return 80 bits of a public key's SHA-256 in five groups, to compare by eye."""
    digest = hashlib.sha256(public).hexdigest()
    return "-".join(digest[start : start + 4] for start in range(0, 20, 4))


@dataclass(frozen=True, slots=True)
class SigningIdentity:
    """A name with the key that proves it.

    Attributes:
        name: of the robot or console.
        public: the raw 32 bytes that others check its signatures with.
    """

    name: str
    public: bytes
    _key: Any = field(repr=False)

    @property
    def fingerprint(self) -> str:
        """The short form of the public key."""
        return fingerprint(self.public)

    @property
    def public_text(self) -> str:
        """The public key as base64url."""
        return ed25519.encode(self.public)

    def sign(self, message: bytes) -> str:
        """Return the signature over ``message`` as base64url."""
        return ed25519.encode(self._key.sign(message))


class KeyFile:
    """The private key of ``name``, in a folder of the state directory.

    Args:
        folder: the purpose of the key, such as :data:`ROBOTS`; part of the path.
        name: an identifier.
        directory: in place of the state directory.
    """

    def __init__(self, folder: str, name: str, directory: Path | None = None) -> None:
        self.name = identifier("name", name)
        self._root = directory or state_dir()
        self.path = self._root / "keys" / identifier("folder", folder) / f"{name}.key"

    def load(self) -> SigningIdentity | None:
        """Return the identity, or None while there is no key.

        Raises:
            KeyFileError: the file or its folder belongs to another user or is open to others, or holds no key.
            OSError: it cannot be read.
        """
        try:
            content = _read_private(self.path, self._root)
        except FileNotFoundError:
            return None
        seed = ed25519.decode(content.decode("ascii", "replace").strip(), SEED_BYTES)
        if seed is None:
            raise KeyFileError(f"{self.path} holds no key; remove it, and a new one is made at the next start.")
        key = ed25519.signing_key(seed)
        return SigningIdentity(self.name, ed25519.public_half(key), key)

    def load_or_make(self) -> SigningIdentity:
        """Return the identity; make its key at the first call.

        Two processes that start at once end up with the same key.

        Raises:
            KeyFileError: as :meth:`load`.
            OSError: it cannot be read or written.
        """
        known = self.load()
        if known is None:
            _make_folder(self.path.parent, self._root)
            write_private(self.path, ed25519.encode(secrets.token_bytes(SEED_BYTES)).encode() + b"\n", once=True)
            known = self.load()
        if known is None:
            raise KeyFileError(f"{self.path} was removed while it was made.")
        return known


def local_name(tenant: str, device_id: str) -> str:
    """Return the name of a device here; two tenants may each have this id.

    A robot has one key on Device Connect's default tenant and on the native mesh.
    """
    return device_id if tenant == DEFAULT_TENANT else f"{tenant}.{device_id}"


def of_tenant(robots: Mapping[str, T], tenant: str) -> dict[str, T]:
    """Return the robots of one tenant of many, by the name that they have there."""
    prefix = local_name(tenant, "")
    own = {name.removeprefix(prefix): each for name, each in robots.items() if name.startswith(prefix)}
    # A device id has no dot: what has one belongs to another tenant.
    return {name: each for name, each in own.items() if "." not in name}


def robot_identity(name: str) -> SigningIdentity | None:
    """Return the identity of a robot of this machine, made at its first start.

    A robot whose key cannot be used is none the less stopped; it answers without a signature, and the log says why.
    """
    try:
        return KeyFile(ROBOTS, name).load_or_make()
    except (StrandsRobotsError, OSError) as exc:
        logger.critical("%s answers without a signature: %s", name, exc)
        return None


def key_here(name: str, directory: Path | None = None) -> bytes | None:
    """Return the public key of a robot of this machine, None without a usable one."""
    try:
        identity = KeyFile(ROBOTS, name, directory).load()
    except (StrandsRobotsError, OSError):
        return None
    return None if identity is None else identity.public


def robots_here(directory: Path | None = None) -> dict[str, SigningIdentity | str]:
    """Return the identities of this machine's robots by name, or why one is unusable."""
    found: dict[str, SigningIdentity | str] = {}
    for path in sorted(((directory or state_dir()) / "keys" / ROBOTS).glob("*.key")):
        try:
            identity = KeyFile(ROBOTS, path.stem, directory).load()
        except (StrandsRobotsError, OSError) as exc:
            found[path.stem] = str(exc)
        else:
            found |= {path.stem: identity} if identity is not None else {}
    return found


@dataclass(frozen=True, slots=True)
class Exemption:
    """Operator's decision that an enrolled robot need not answer a stop.

    Attributes:
        state: ``retired`` or ``off``.
        by: the operator.
        reason: or "".
        at: wall-clock seconds.
    """

    state: str
    by: str
    reason: str
    at: float


@dataclass(frozen=True, slots=True)
class EnrolledRobot:
    """Record of an enrolled robot.

    Attributes:
        key: its public key.
        networks: where it was enrolled, the latest last; empty in a record of an earlier release, which counts on
            every network until the robot has answered signed.
        exemption: None while it must answer.
        cell: that it stated as it was enrolled, "" for none; None where that is unknown.
    """

    key: bytes
    networks: tuple[NetworkKey, ...] = ()
    exemption: Exemption | None = None
    cell: str | None = None

    def at(self, network: NetworkKey) -> EnrolledRobot:
        """Return the record with this network besides those it has."""
        others = (each for each in self.networks if not each.meets(network))
        return replace(self, networks=(*others, network)[-NETWORKS_MAX:])


class EnrolledKeys:
    """File ``enrolled.json``: public keys of robots, learnt once and compared since.

    Args:
        directory: in place of the state directory.
    """

    def __init__(self, directory: Path | None = None) -> None:
        self._root = directory or state_dir()
        self.path = self._root / "enrolled.json"

    def load(self) -> dict[str, bytes]:
        """Return the public keys by robot.

        Raises:
            KeyFileError: the file belongs to another user or is open to others, or holds no keys.
            OSError: it cannot be read.
        """
        return {name: robot.key for name, robot in self.robots().items()}

    def robots(self) -> dict[str, EnrolledRobot]:
        """Return the records by robot.

        Raises:
            KeyFileError, OSError: as :meth:`load`.
        """
        try:
            content = _read_private(self.path, self._root)
        except FileNotFoundError:
            return {}
        try:
            data = json.loads(content)
            robots = {str(name): _robot(each) for name, each in data["robots"].items()}
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as exc:
            raise KeyFileError(f"{self.path} holds no enrolled keys: {exc!r}") from exc
        known = {name: robot for name, robot in robots.items() if robot is not None}
        if data.get("v") != VERSION or len(known) != len(robots):
            raise KeyFileError(f"{self.path} holds no enrolled keys of version {VERSION}.")
        return known

    def enroll(
        self,
        found: Mapping[str, bytes],
        *,
        replace: bool = False,
        network: NetworkKey | None = None,
        cells: Mapping[str, str] | None = None,
    ) -> dict[str, Exemption]:
        """Keep these public keys beside those already there; return exemptions undone.

        Args:
            found: keys of robots that were heard with them.
            replace: a robot's changed key is taken, and it is expected on this network alone of its kind.
            network: where they were heard.
            cells: that they state now; of the others what was known stays.

        Raises:
            KeyChangedError: a robot has another key here, and ``replace`` is false; nothing was kept.
            KeyFileError, OSError: as :meth:`load`, or the file cannot be written.
        """
        undone: dict[str, Exemption] = {}
        with self._changing() as known:
            for name, public in found.items():
                identifier("name", name)
                robot = known.get(name)
                if robot is not None and not replace and robot.key != public:
                    raise KeyChangedError(
                        f"{name} shows the key {fingerprint(public)} and is enrolled with {fingerprint(robot.key)}: "
                        f"it was set up anew, or this is another machine. If you know why, enroll it with --replace."
                    )
                if robot is not None and robot.exemption is not None:
                    undone[name] = robot.exemption
                networks = robot.networks if robot is not None else ()
                if replace and network is not None:
                    networks = tuple(each for each in networks if each.kind != network.kind)
                cell = (cells or {}).get(name, robot.cell if robot is not None else None)
                record = EnrolledRobot(public, networks, cell=cell)
                known[name] = record if network is None else record.at(network)
        return undone

    def forget(self, name: str) -> bool:
        """Remove a robot; False when it was not enrolled.

        Raises:
            KeyFileError, OSError: as :meth:`enroll`.
        """
        with self._changing() as known:
            return known.pop(name, None) is not None

    def exempt(self, name: str, exemption: Exemption) -> bool:
        """Record that a robot need not answer; False when it is not enrolled.

        Raises:
            KeyFileError, OSError: as :meth:`enroll`.
        """
        with self._changing() as known:
            if name in known:
                known[name] = replace(known[name], exemption=exemption)
            return name in known

    def heard(self, name: str, key: bytes, network: NetworkKey) -> Exemption | None:
        """Record that a robot answered, signed with ``key``; return the exemption undone.

        Another key than the enrolled one changes nothing. A record of an earlier release takes the network; one that
        has a network keeps it, because an answer may be relayed from there.

        Raises:
            KeyFileError, OSError: as :meth:`enroll`.
        """
        if not self._learns(self.robots().get(name), key):
            return None
        with self._changing() as known:
            robot = known.get(name)
            if robot is None or not self._learns(robot, key):
                return None
            where = robot if robot.networks else robot.at(network)
            known[name] = replace(where, exemption=None)
            return robot.exemption

    @staticmethod
    def _learns(robot: EnrolledRobot | None, key: bytes) -> bool:
        if robot is None or robot.key != key:
            return False
        return not robot.networks or robot.exemption is not None

    @contextlib.contextmanager
    def _changing(self) -> Iterator[dict[str, EnrolledRobot]]:
        """Yield the records for one process at a time; write them if changed."""
        make_private(self._root)
        descriptor = os.open(self._root, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            _lock(descriptor, self.path)
            known = self.robots()
            before = dict(known)
            yield known
            if known != before:
                self._save(known)
        finally:
            os.close(descriptor)

    def _save(self, robots: Mapping[str, EnrolledRobot]) -> None:
        records = {name: _record(robot) for name, robot in sorted(robots.items())}
        content = json.dumps({"v": VERSION, "saved": time.time(), "robots": records}, indent=1).encode()
        if len(content) >= FILE_MAX_BYTES:
            raise KeyFileError(f"{self.path} would be too long: forget robots first.")
        write_private(self.path, content)


def _robot(record: Mapping[str, Any]) -> EnrolledRobot | None:
    """Read a record; one of an earlier release has a key alone.

    Raises:
        ValueError, KeyError, TypeError, AttributeError: it is none.
    """
    key = ed25519.decode(record["key"], SEED_BYTES)
    if key is None:
        return None
    networks = tuple(NetworkKey.parse(each) for each in record.get("networks", ()))
    exempt, cell = record.get("exempt"), record.get("cell")
    cell = None if cell is None else str(cell)
    if exempt is None:
        return EnrolledRobot(key, networks, cell=cell)
    if exempt["state"] not in EXEMPT_STATES:
        raise ValueError(f"no state of an exempt robot: {exempt['state']!r}")
    stated = Exemption(exempt["state"], str(exempt["by"]), str(exempt["reason"]), float(exempt["at"]))
    return EnrolledRobot(key, networks, stated, cell)


def _record(robot: EnrolledRobot) -> dict[str, Any]:
    record: dict[str, Any] = {"key": ed25519.encode(robot.key)}
    if robot.networks:
        record["networks"] = [each.text for each in robot.networks]
    if robot.cell is not None:
        record["cell"] = robot.cell
    if robot.exemption is not None:
        record["exempt"] = field_values(robot.exemption)
    return record


def _lock(descriptor: int, path: Path) -> None:
    """Wait for other processes that change the file.

    Raises:
        KeyFileError: one of them has it for longer than :data:`LOCK_S`.
    """
    until = time.monotonic() + LOCK_S
    while True:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if time.monotonic() >= until:
                raise KeyFileError(f"{path} is being changed by another process.") from None
            time.sleep(0.01)
        else:
            return


def _read_private(path: Path, root: Path) -> bytes:
    """Return the content of a file that is this user's alone."""
    return read_private(path, root, forbidden=OPEN, longest=FILE_MAX_BYTES, error=KeyFileError)


def _make_folder(folder: Path, root: Path) -> None:
    make_private(folder)
    require_private(folder, root, error=KeyFileError)


PUBLIC_KEYS = "STRANDS_MESH_CONSOLE_PUBLIC_KEYS"


def console_key() -> KeyFile:
    """Return the file with the key of this user's consoles on this machine."""
    return KeyFile("consoles", "console")


def enrolled_consoles() -> EnrolledKeys:
    """Return the file with the public keys of consoles on other machines."""
    return EnrolledKeys(state_dir() / "consoles")


def stated_consoles() -> frozenset[bytes]:
    """Return the public keys that the environment names."""
    return frozenset(ed25519.public_keys(settings.items(PUBLIC_KEYS), PUBLIC_KEYS))


def kept_consoles() -> frozenset[bytes]:
    """Return the own public key, if there is one, and the enrolled ones.

    Raises:
        KeyFileError, OSError: a key file cannot be used.
    """
    own = console_key().load()
    return frozenset({*enrolled_consoles().load().values(), *([own.public] if own is not None else [])})


KEYS_AGAIN_S = 10.0
"""Seconds after which the keys of this machine and the enrolled ones are read again."""

KEYS_MAX = 512


class KnownKeys:
    """Keys of this machine's robots, of enrolled ones, and of those who may stop."""

    def __init__(self, tenant: str = DEFAULT_TENANT, stop_keys: Sequence[bytes] = ()) -> None:
        self._tenant, self._stop_keys = tenant, frozenset(stop_keys)
        self._known: dict[str, bytes | None] = {}
        self._enrolled: Mapping[str, bytes] = {}
        self._read = float("-inf")

    def knows(self, name: str, key: bytes) -> bool:
        """Return True where ``key`` is that of ``name``, or may stop robots."""
        if key in self._stop_keys:
            return True
        if time.monotonic() - self._read > KEYS_AGAIN_S:
            self._read, self._known, self._enrolled = time.monotonic(), {}, _enrolled()
        own = local_name(self._tenant, name)
        if self._enrolled.get(own) == key:
            return True
        if own not in self._known and len(self._known) < KEYS_MAX:
            self._known[own] = key_here(own)
        return self._known.get(own) == key


def _enrolled() -> Mapping[str, bytes]:
    try:
        return EnrolledKeys().load()
    except (StrandsRobotsError, OSError):
        return {}
