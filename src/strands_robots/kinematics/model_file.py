"""Loading of a robot model's file, bounded before MuJoCo reads it.

A file of a few kilobytes may ask for a million bodies, a mesh or a picture of gigabytes, or a depth at which the
parser's stack ends and the process with it. All of that is counted in the XML and in the sizes of the files that it
names, and is refused by name.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.parsers import expat

from strands_robots.errors import StrandsRobotsError
from strands_robots.utils import ValidationError, shown

MIB = 2**20
XML_MAX_BYTES = 16 * MIB
ELEMENTS_MAX = 200_000
DEPTH_MAX = 200
FILES_MAX = 256
"""XML files that a model includes."""

BODIES_MAX = 10_000
"""Bodies after replication, and the particles of composites and flexes."""

ASSETS_MAX_BYTES = 512 * MIB
ASSET_MAX_BYTES = 64 * MIB
POINTS_MAX = 128 * MIB
"""Pixels of pictures, points of height fields, and numbers that an element asks for."""

SIZE_MAX = 10_000_000
"""Largest count in a model's ``size``."""

MEMORY_MAX_BYTES = 2**30
_CHUNK = 64 * 1024
_ASSETS = frozenset({"mesh", "hfield", "texture", "skin", "flexcomp", "composite"})
_UNITS = {"K": 2**10, "M": 2**20, "G": 2**30, "T": 2**40, "P": 2**50, "E": 2**60}


def load_model(path: Path, label: str) -> Any:
    """Return a fresh ``MjSpec`` of an MJCF or URDF file.

    Raises:
        ValidationError: no such model, one that MuJoCo refuses, or one beyond a bound, which the message names.
    """
    import mujoco  # noqa: PLC0415 - slow to load, and a simulation chooses its renderer before

    try:
        check_model(path)
        return mujoco.MjSpec.from_file(str(path))
    except ModelBoundError as exc:
        raise ValidationError(f"model {shown(label)} is refused: {exc}.") from None
    except (ValueError, OSError, mujoco.FatalError) as exc:
        raise ValidationError(f"model {shown(label)} cannot be loaded: {' '.join(str(exc).split())[:300]}") from exc


class ModelBoundError(StrandsRobotsError, ValueError):
    """A model is beyond a bound; the message names it."""


def check_model(path: Path) -> None:
    """Check a model's XML and the files that it names against the bounds.

    Raises:
        ModelBoundError: a bound is exceeded, or a file is no XML.
        OSError: a file cannot be read.
    """
    _Model(path.parent, _Totals()).read(path)


@dataclass(slots=True)
class _Totals:
    elements: float = 0.0
    files: int = 0
    bodies: float = 0.0
    attached: float = 0.0
    largest: float = 0.0
    asset_bytes: int = 0
    points: float = 0.0
    open: list[Path] = field(default_factory=list)
    seen: set[Path] = field(default_factory=set)


class _Model:
    """One model or submodel: its XML files, and the files that they name."""

    def __init__(self, folder: Path, totals: _Totals) -> None:
        self._folder = folder
        self._totals = totals
        self._folders: dict[str, str] = {}
        self._asked: list[tuple[str, dict[str, str]]] = []

    def read(self, path: Path) -> None:
        self._xml(path, 1.0, 0)
        totals = self._totals
        totals.open.append(path.resolve())
        # Where assets are may be stated behind them.
        for tag, attributes in self._asked:
            self._asset(tag, attributes)
        totals.open.pop()
        _require(totals.attached * totals.largest <= BODIES_MAX, f"it attaches more than {BODIES_MAX:,} bodies")

    def _xml(self, path: Path, times: float, depth: int) -> None:
        totals = self._totals
        totals.files += 1
        _require(totals.files <= FILES_MAX, f"it includes more than {FILES_MAX} files")
        real, opened = path.resolve(), totals.open
        _require(real not in opened, f"{path.name} includes itself")
        _require(real.is_file(), f"{path.name} is no file")
        _require(real.stat().st_size <= XML_MAX_BYTES, f"{path.name} has more than {XML_MAX_BYTES // MIB} MiB")
        opened.append(real)
        _Xml(self, times, depth).parse(real)
        opened.pop()

    def element(self, tag: str, attributes: Mapping[str, str], times: float, depth: int) -> float:
        """Count an element; return how many times what it holds is made."""
        totals = self._totals
        totals.elements += times
        _require(totals.elements <= ELEMENTS_MAX, f"it has more than {ELEMENTS_MAX:,} elements")
        _require(depth <= DEPTH_MAX, f"its elements are more than {DEPTH_MAX} deep")
        if tag == "compiler":
            self._folders.update({name: attributes[name] for name in _FOLDERS if name in attributes})
        elif tag == "size":
            self._size(attributes)
        elif tag in ("replicate", "composite", "flexcomp"):
            count = math.prod(_numbers(attributes.get("count", "1"), tag))
            _require(count <= BODIES_MAX, f"{tag} asks for {count:,.0f} parts, more than {BODIES_MAX:,}")
            times *= max(count, 1.0) if tag == "replicate" else 1.0
            totals.bodies += 0 if tag == "replicate" else count * times
        elif tag in ("body", "link"):
            totals.bodies += times
        elif tag == "attach":
            totals.attached += times
        elif tag == "include" and "file" in attributes:
            self._include(attributes["file"], times, depth)
        elif tag in ("hfield", "texture"):
            self._pixels(tag, attributes)
        for name in _COUNTS.get(tag, ("dim", "actdim", "nsample")):
            if name in attributes:
                self._add_points(math.prod(_numbers(attributes[name], name)), f"{name} of {tag}")
        _require(totals.bodies <= BODIES_MAX, f"it has more than {BODIES_MAX:,} bodies")
        if tag in _ASSETS or (tag == "model" and "file" in attributes):
            self._asked.append((tag, dict(attributes)))
        return times

    def _include(self, name: str, times: float, depth: int) -> None:
        path = self._found(name, "")
        if path is not None:
            self._xml(path, times, depth)

    def _size(self, attributes: Mapping[str, str]) -> None:
        for name, text in attributes.items():
            unit = _UNITS.get(text.strip()[-1:].upper(), 1)
            value = math.prod(_numbers(text.strip()[:-1] if unit > 1 else text, name)) * unit
            if name in ("memory", "nstack"):
                value *= 8 if name == "nstack" else 1
                _require(value <= MEMORY_MAX_BYTES, f"its size asks for {value / MIB:,.0f} MiB of {name}, above 1,024")
            else:
                _require(value <= SIZE_MAX, f"its size asks for {value:,.0f} {name}, more than {SIZE_MAX:,}")

    def _pixels(self, tag: str, attributes: Mapping[str, str]) -> None:
        names = ("nrow", "ncol") if tag == "hfield" else ("width", "height")
        area = math.prod(math.prod(_numbers(attributes.get(name, "0"), name)) for name in names)
        faces = 6 if attributes.get("type", "cube") in ("cube", "skybox") and tag == "texture" else 1
        self._add_points(area * faces, f"{tag} {attributes.get('name', '')}".strip())

    def _add_points(self, points: float, what: str) -> None:
        self._totals.points += points
        _require(
            self._totals.points <= POINTS_MAX,
            f"{what} takes its pictures, height fields and arrays above {POINTS_MAX // MIB} million values",
        )

    def _asset(self, tag: str, attributes: Mapping[str, str]) -> None:
        for name, text in attributes.items():
            if name.startswith("file"):
                path = self._found(text, "texturedir" if tag == "texture" else "meshdir")
                _require(path is None or path.resolve() not in self._totals.open, f"{text} includes itself")
                if path is not None and path.resolve() not in self._totals.seen:
                    self._totals.seen.add(path.resolve())
                    self._file(tag, path)

    def _file(self, tag: str, path: Path) -> None:
        if tag == "model" or path.suffix.lower() in (".xml", ".mjcf", ".urdf"):
            before = self._totals.bodies
            _Model(path.parent, self._totals).read(path)
            self._totals.largest = max(self._totals.largest, self._totals.bodies - before)
            return
        _require(path.is_file(), f"{path.name} is no regular file")
        size = path.stat().st_size
        _require(size <= ASSET_MAX_BYTES, f"{path.name} has more than {ASSET_MAX_BYTES // MIB} MiB")
        self._totals.asset_bytes += size
        _require(
            self._totals.asset_bytes <= ASSETS_MAX_BYTES,
            f"{path.name}, of {size / MIB:,.0f} MiB, takes its meshes and pictures above {ASSETS_MAX_BYTES // MIB} MiB",
        )
        with path.open("rb") as file:
            begin = file.read(32)
        if begin[:8] == b"\x89PNG\r\n\x1a\n" and len(begin) >= 24:
            width, height = struct.unpack(">II", begin[16:24])
            self._add_points(float(width) * height, path.name)

    def _found(self, name: str, folder: str) -> Path | None:
        """Return the file that a model names, or None, as MuJoCo looks for it."""
        stated = Path(name.removeprefix("package://").removeprefix("file://"))
        below = self._folders.get(folder) or self._folders.get("assetdir") or ""
        places = [self._folder / below / stated, self._folder / stated]
        places += [self._folder / below / stated.name, self._folder / stated.name]
        places += [each.parent / stated for each in self._totals.open]
        return next((each for each in places if each.exists()), None)


_COUNTS = {"numeric": ("size",), "flexcomp": (), "flex": ()}
"""Attributes that ask for so many numbers, by element; ``dim`` of a flex is its dimension."""

_FOLDERS = ("meshdir", "texturedir", "assetdir")


class _Xml:
    """One XML file of a model, element by element."""

    def __init__(self, model: _Model, times: float, depth: int) -> None:
        self._model = model
        self._times = [times]
        self._depth = depth
        self._tags: list[str] = []

    def parse(self, path: Path) -> None:
        parser = expat.ParserCreate()
        parser.StartElementHandler = self._start
        parser.EndElementHandler = self._end
        parser.EntityDeclHandler = _no_entity
        with path.open("rb") as file:
            more: Callable[[], bytes] = lambda: file.read(_CHUNK)  # noqa: E731 - read in two places
            data = more()
            try:
                while data:
                    parser.Parse(data, False)
                    data = more()
                parser.Parse(b"", True)
            except expat.ExpatError as exc:
                # What MuJoCo's own parser takes and this one does not would not have been counted.
                raise ModelBoundError(f"{path.name} is no XML: {exc}") from None

    def _start(self, tag: str, attributes: dict[str, str]) -> None:
        self._tags.append(tag)
        self._times.append(self._model.element(tag, attributes, self._times[-1], self._depth + len(self._tags)))

    def _end(self, tag: str) -> None:
        self._tags.pop()
        self._times.pop()


def _no_entity(*declared: object) -> None:
    raise ModelBoundError("it declares XML entities")


def _numbers(text: str, name: str) -> list[float]:
    try:
        values = [float(each) for each in text.split()]
    except ValueError:
        return [0.0]  # MuJoCo says what is wrong with it
    _require(all(math.isfinite(each) for each in values), f"{name} is no finite number")
    return [max(each, 0.0) for each in values] or [0.0]


def _require(condition: object, why: str) -> None:
    if not condition:
        raise ModelBoundError(why)
