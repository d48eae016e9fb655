"""Value domains, identifiers, texts of others, canonical JSON and quaternions.

Every check returns the value, typed, or raises :class:`ValidationError` with the argument, the value and the domain
in its message. The edges (RPC handlers, constructors, wire decoders) call a check once; the code inside trusts its
types. Booleans are not numbers, and NaN is not a number.
"""

from __future__ import annotations

import getpass
import ipaddress
import json
import math
import os
import re
import threading
import weakref
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from importlib import import_module
from itertools import islice
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from strands_robots.errors import StrandsRobotsError
from strands_robots.moved import of_module

if not TYPE_CHECKING:
    __path__, __getattr__ = of_module(__name__)


DISTRIBUTION = "strands-robots-edge"
"""Name of this project on a package index; ``strands-robots`` is another project's."""

DURATION_MAX_S = 3600.0
"""Longest task, drive, goal or teleoperation, in seconds."""

START_S = 10.0
"""Seconds in which a robot has to have started a motion; after that what it may still start is void."""

WAIT_S = 25.0
"""Longest time for which an answer waits for the end of a motion; the networks wait for 30 s."""

IDENTIFIER_MAX = 128
"""Longest peer id and message identifier, in characters (the mesh wire's bound)."""

RESERVED_IDS = ("broadcast", "safety")
"""Words that stand where a peer id does in the mesh's topics."""

RESERVED_DEVICE_IDS = (*RESERVED_IDS, "discovery", "registry")
"""Words that stand there in the topics of either network."""

_IDENTIFIER = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*\Z")
_DEVICE_ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]*\Z")
_HOSTNAME = re.compile(r"[A-Za-z0-9_]([A-Za-z0-9_-]*[A-Za-z0-9_])?(\.[A-Za-z0-9_]([A-Za-z0-9_-]*[A-Za-z0-9_])?)*\.?\Z")
_CREDENTIALS = re.compile(r"//[^\s\"']*@")
_ESCAPE = re.compile(
    r"\x1b(?:\[[0-?]*[ -/]*[@-~]|[\]PX^_][^\x07\x1b]*(?:\x07|\x1b\\)?|[ -/]*[0-~])|\x9b[0-?]*[ -/]*[@-~]"
)
_SHOWN_MAX = 80

NEAR_MAX, NAMES_MAX, NAMED_MAX = 64, 1000, 20
"""Letters of a name and names that are compared for likeness, and names that a sentence lists."""


class ValidationError(StrandsRobotsError, ValueError):
    """A value outside its domain. ``code`` is for machines, the message for people."""

    def __init__(self, message: str, code: str = "INVALID") -> None:
        super().__init__(message)
        self.code = code


class MissingExtraError(StrandsRobotsError, ImportError):
    """An optional dependency is missing; the message names its extra."""


def joint_name(key: str) -> str:
    """Return the joint of a key, without what drivers and older datasets add."""
    return key.removeprefix("main_").removesuffix(".pos")


def install_line(extra: str) -> str:
    """Return the command that adds an extra to this clone or installation."""
    if (Path(__file__).resolve().parents[2] / "pyproject.toml").is_file():
        return f"in the clone, .venv/bin/pip install -e '.[{extra}]'"
    return f"pip install '{DISTRIBUTION}[{extra}]'"


def missing_extra(what: str, extra: str) -> MissingExtraError:
    """Return the error for a missing package, with the command that installs it."""
    return MissingExtraError(f"{what} needs the [{extra}] extra: {install_line(extra)}.")


def optional_module(name: str, *, what: str, extra: str) -> Any:
    """Return the module ``name``, imported where it is used.

    Raises:
        MissingExtraError: it is not installed; ``what`` needs it, and ``extra`` has it.
    """
    try:
        return import_module(name)
    except ModuleNotFoundError as exc:
        raise missing_extra(what, extra) from exc


def is_loopback_host(host: str) -> bool:
    """Return True for an address of loopback, and for ``localhost``."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


NESTED_MAX = 100
"""Levels of lists and objects in a value that a call takes."""


def shown(value: object) -> str:
    """Return ``repr(value)``, short enough for a log or a reply."""
    if isinstance(value, str | bytes) and len(value) > _SHOWN_MAX:
        return f"{value[:_SHOWN_MAX]!r}... ({len(value)} long)"
    if isinstance(value, list | tuple | dict | set) and len(value) > 8:
        return f"a {type(value).__name__} of {len(value)}"
    if isinstance(value, int) and not isinstance(value, bool) and value.bit_length() > 256:
        return f"an integer of {value.bit_length()} bits"
    try:
        text = repr(value)
    except Exception as exc:  # noqa: BLE001 - a foreign __repr__ may raise anything
        return f"a {type(value).__name__} whose repr raises {type(exc).__name__}"
    return text if len(text) <= _SHOWN_MAX else f"{text[:_SHOWN_MAX]}..."


def plain_text(value: object, longest: int = 2000, *, lines: bool = False) -> str:
    """Return a text of others without what a terminal would act on; "" for no text.

    Args:
        value: the text as it came.
        longest: characters after which it is cut.
        lines: keep line ends; else they become spaces.
    """
    if not isinstance(value, str):
        return ""
    cut = _ESCAPE.sub("", value[: 2 * longest])
    spaced = "".join(" " if char.isspace() and char != "\n" else char for char in cut)
    kept = "".join(char for char in spaced if char.isprintable() or char == "\n")
    shortened = kept if len(kept) <= longest and len(value) <= 2 * longest else f"{kept[: longest - 3]}..."
    return shortened.strip() if lines else " ".join(shortened.split())


def alike(wanted: str, names: Iterable[str], most: int = 3) -> list[str]:
    """Return the names that resemble ``wanted``, the nearest first."""
    import difflib  # noqa: PLC0415 - only a name that is not there needs it

    known = [name for name in islice(names, NAMES_MAX) if len(name) <= NEAR_MAX]
    return difflib.get_close_matches(wanted[:NEAR_MAX], known, n=most, cutoff=0.4)


def near(wanted: str, names: Iterable[str]) -> str:
    """Return a sentence with the names that resemble one, else with all."""
    known = sorted(name for name in islice(names, NAMES_MAX) if len(name) <= NEAR_MAX)
    resembling = alike(wanted, known)
    if resembling:
        return f" Near it: {', '.join(resembling)}."
    more = f" and {len(known) - NAMED_MAX} more" if len(known) > NAMED_MAX else ""
    return f" There {'is' if len(known) == 1 else 'are'}: {', '.join(known[:NAMED_MAX])}{more}." if known else ""


_PYTHONS_OWN = frozenset({bool, int, float, str, bytes, list, tuple, dict, set, type(None)})


def plain_value(value: object) -> Any:
    """Return numpy's scalars and arrays as numbers, booleans and lists.

    Other values stay as they are. What has a ``tolist`` counts as one, so that numpy is not needed for it.
    """
    if type(value) in _PYTHONS_OWN:
        return value
    try:
        convert = getattr(value, "tolist", None)
        # Times and durations have integers inside, and are none.
        found = convert() if callable(convert) and _kind(value) not in ("m", "M") else value
        # The widest float of numpy has no number of Python's own to become.
        if type(found) not in _PYTHONS_OWN and isinstance(found, Real):
            found = float(found)
    except Exception:  # noqa: BLE001 - a stranger's object raises what it likes; it is no number then
        return value
    # A test double answers with another one, and that with the next.
    return found if type(found) in _PYTHONS_OWN else value


def plain_scalar(value: object) -> Any:
    """Return one number or boolean of numpy's as Python's, and an array as it is.

    A picture among the joints of a robot would hold the interpreter for many ms, and a stop with it.
    """
    size = getattr(value, "size", 1)
    return value if isinstance(size, int) and size != 1 else plain_value(value)


def _kind(value: object) -> object:
    return getattr(getattr(value, "dtype", None), "kind", "")


def json_value(value: object) -> Any:
    """Return what JSON carries in place of a value that it does not know.

    Raises:
        TypeError: it has nothing for it.
    """
    found = plain_value(value)
    if found is value:
        raise TypeError(f"{type(value).__name__} {shown(value)} is no value of JSON")
    return found


def canonical_json(fields: Mapping[str, Any]) -> bytes:
    """Return the bytes that are signed: JSON with sorted keys and without blanks.

    Raises:
        ValueError: a number that JSON cannot carry.
    """
    return json.dumps(fields, sort_keys=True, separators=(",", ":"), allow_nan=False, default=json_value).encode()


def field_values(instance: Any) -> dict[str, Any]:
    """Return the fields of a dataclass by name, without a copy of their values."""
    return {name: getattr(instance, name) for name in instance.__dataclass_fields__}


def redacted(text: str) -> str:
    """Return ``text`` without the credentials of URLs in it."""
    return _CREDENTIALS.sub("//***@", text)


def number(
    name: str,
    value: object,
    *,
    low: float | None = None,
    high: float | None = None,
    above: float | None = None,
) -> float:
    """Return a finite float; ``low`` and ``high`` are included, ``above`` is not."""
    plain = value if type(value) in _PYTHONS_OWN else plain_scalar(value)
    if isinstance(plain, int | float) and not isinstance(plain, bool):
        try:
            result = float(plain)
        except OverflowError:
            result = math.inf
        inside = (
            math.isfinite(result)
            and (low is None or result >= low)
            and (high is None or result <= high)
            and (above is None or result > above)
        )
        if inside:
            return result
    # The text of the domain is made for a refusal only, because every command of every robot passes this check.
    raise ValidationError(f"{name} must be {_domain('a finite number', low, high, above)}, not {shown(value)}.")


def finite(name: str, value: object) -> None:
    """Refuse NaN and infinity in a JSON value of at most :data:`NESTED_MAX` levels.

    Raises:
        ValidationError: naming the place, such as ``joints.pan`` or ``path[2]``.
    """
    left: list[tuple[str, object, int]] = [(name, value, 0)]
    while left:
        place, each, depth = left.pop()
        each = each if type(each) in _PYTHONS_OWN else plain_value(each)
        inside: list[tuple[str, object]] = []
        if isinstance(each, Mapping):
            inside = [(f"{place}.{key}", one) for key, one in each.items()]
        elif isinstance(each, list | tuple):
            inside = [(f"{place}[{index}]", one) for index, one in enumerate(each)]
        elif isinstance(each, float) and not math.isfinite(each):
            raise ValidationError(f"{place} must be finite, not {each}.")
        if inside and depth == NESTED_MAX:
            raise ValidationError(f"{name} must be nested at most {NESTED_MAX} levels deep.")
        left += [(where, one, depth + 1) for where, one in reversed(inside)]


def whole(name: str, value: object, *, low: float | None = None, high: float | None = None) -> int:
    """Return an integer, bounds included; ``True`` is not 1 and 2.0 is not 2."""
    plain = value if type(value) in _PYTHONS_OWN else plain_scalar(value)
    if isinstance(plain, int) and not isinstance(plain, bool):
        inside = (low is None or plain >= low) and (high is None or plain <= high)
        if inside:
            return plain
    raise ValidationError(f"{name} must be {_domain('an integer', low, high, None)}, not {shown(value)}.")


def integral(name: str, value: object, *, low: float | None = None, high: float | None = None) -> int:
    """Return an integer of a message; 4.0 is 4, and ``True`` is not 1."""
    plain = value if type(value) in _PYTHONS_OWN else plain_scalar(value)
    if isinstance(plain, float) and plain.is_integer():
        plain = int(plain)
    return whole(name, plain if isinstance(plain, int) else value, low=low, high=high)


def duration(name: str, value: object) -> float:
    """Seconds above 0 and at most :data:`DURATION_MAX_S`."""
    return number(name, value, above=0, high=DURATION_MAX_S)


def flag(name: str, value: object) -> bool:
    """Return ``value`` as a boolean; a spelling of one, 0 and 1 are refused."""
    plain = value if type(value) in _PYTHONS_OWN else plain_scalar(value)
    if not isinstance(plain, bool):
        raise ValidationError(f"{name} must be true or false, not {shown(value)}.")
    return plain


def text(name: str, value: object, *, longest: int = 2000, empty: bool = False) -> str:
    """Return text without control characters; blank only with ``empty``."""
    domain = f"text of {0 if empty else 1} to {longest} characters without control characters"
    if not isinstance(value, str):
        raise ValidationError(f"{name} must be {domain}, not {shown(value)}.")
    unprintable = any(ord(c) < 32 or 127 <= ord(c) < 160 or 0xD800 <= ord(c) < 0xE000 for c in value[: longest + 1])
    if len(value) > longest or unprintable or (not empty and not value.strip()):
        raise ValidationError(f"{name} must be {domain}, not {shown(value)}.")
    return value


def choice(name: str, value: object, allowed: tuple[str, ...]) -> str:
    """Return ``value`` when it is one of the allowed strings."""
    if not isinstance(value, str) or value not in allowed:
        raise ValidationError(f"{name} must be one of {', '.join(allowed)}, not {shown(value)}.")
    return value


def mapping(name: str, value: object) -> dict[str, Any]:
    """Return ``value`` as a JSON object."""
    if not isinstance(value, dict) or not all(isinstance(key, str) for key in value):
        raise ValidationError(f"{name} must be an object with string keys, not {shown(value)}.")
    return value


def identifier(name: str, value: object) -> str:
    """Return a peer id or a message identifier."""
    domain = f"1 to {IDENTIFIER_MAX} letters, digits, '.', '_' or '-', the first one alphanumeric"
    if not isinstance(value, str) or len(value) > IDENTIFIER_MAX or not _IDENTIFIER.match(value):
        raise ValidationError(f"{name} must be {domain}, not {shown(value)}.")
    return value


def device_id(name: str, value: object) -> str:
    """Return an id on Device Connect, without dots, which discovery cannot see."""
    domain = f"1 to {IDENTIFIER_MAX} letters, digits, '_' or '-', the first one alphanumeric, without dots"
    if not isinstance(value, str) or len(value) > IDENTIFIER_MAX or not _DEVICE_ID.match(value):
        raise ValidationError(f"{name} must be {domain}, not {shown(value)}.")
    return value


def peer_id(name: str, value: object) -> str:
    """Return an id that a peer of the mesh may take."""
    return unreserved(name, identifier(name, value), RESERVED_IDS)


def own_device_id(name: str, value: object) -> str:
    """Return an id that a device of ours may take on Device Connect."""
    return unreserved(name, device_id(name, value), RESERVED_DEVICE_IDS)


def unreserved(name: str, value: str, reserved: tuple[str, ...]) -> str:
    """Return ``value``, which is none of the words that networks use for themselves."""
    if value in reserved:
        raise ValidationError(
            f"{name} must not be {' or '.join(reserved)}, which are levels of the network's topics, not {shown(value)}."
        )
    return value


def port(name: str, value: object) -> int:
    """Return a TCP port, 1 to 65535."""
    return whole(name, value, low=1, high=65535)


def dial_host_error(value: object) -> str | None:
    """Return the reason why ``value`` is no bare host name or address, or None."""
    domain = "a bare hostname or IP address"
    if not isinstance(value, str) or not 0 < len(value) <= 253:
        return f"host must be {domain}, not {shown(value)}."
    try:
        ipaddress.ip_address(value.strip("[]"))
    except ValueError:
        return None if _HOSTNAME.match(value) else f"host must be {domain}, not {shown(value)}."
    return None


def teleoperator_contract_error(teleoperator: object) -> str | None:
    """Return the reason why ``teleoperator`` cannot lead a robot, or None."""
    if callable(getattr(teleoperator, "get_action", None)):
        return None
    return f"teleoperator must have a callable get_action(), and {shown(teleoperator)} has none."


def w_positive(quat: Sequence[float]) -> list[float]:
    """Return the quaternion (w, x, y, z) of a rotation whose w is not negative."""
    return [-value for value in quat] if quat[0] < 0 else list(quat)


def yaw_of(quat: Sequence[float]) -> float:
    """Return the rotation about z, radians, of a quaternion (w, x, y, z).

    It need not be normalised. The z-y-x Euler yaw, ``atan2(2(wz + xy), w² + x² - y² - z²)``.
    """
    w, x, y, z = quat
    return math.atan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z)


def _domain(kind: str, low: float | None, high: float | None, above: float | None) -> str:
    if above is not None:
        return f"{kind} above {above:g}" + (f" and at most {high:g}" if high is not None else "")
    if low is not None and high is not None:
        return f"{kind} from {low:g} to {high:g}"
    if low is not None:
        return f"{kind} of at least {low:g}"
    return f"{kind} of at most {high:g}" if high is not None else kind


def operator() -> str:
    """Return the login name of the operator at this machine."""
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        return f"uid {os.getuid()}"


T = TypeVar("T")


class IdentityMap(Generic[T]):
    """Values by the identity of objects; thread-safe.

    The objects may be equal, or have no hash. A value goes with its object. An object that cannot be referred to
    weakly is kept for good.
    """

    def __init__(self) -> None:
        self._values: dict[int, tuple[object, T]] = {}
        self._lock = threading.Lock()

    def of(self, key: object, make: Callable[[], T]) -> T:
        """Return the value of ``key``, made at the first question."""
        known = self._values.get(id(key))
        if known is None:
            with self._lock:
                known = self._values.get(id(key))
                if known is None:
                    known = self._values[id(key)] = self._reference(key), make()
        return known[1]

    def get(self, key: object) -> T | None:
        """Return the value of ``key``, None before it was made."""
        known = self._values.get(id(key))
        return None if known is None else known[1]

    def _reference(self, key: object) -> object:
        try:
            # Called by the garbage collector, on any thread: it may take no lock.
            return weakref.ref(key, partial(self._forget, id(key)))
        except TypeError:
            return key

    def _forget(self, at: int, _: object) -> None:
        self._values.pop(at, None)
