"""A robot model's file: loaded within bounds, its position servos, its tip.

A file of a few kilobytes may ask for a million bodies, a mesh or a picture of gigabytes, or a depth at which the
parser's stack ends and the process with it. All of that is counted in the XML and in the sizes of the files that it
names, and is refused by name.

The tip is the site that motions place, the first of these:

1. The site or body that the caller names.
2. A site called ``gripper_tip``.
3. Of the sites with one of :data:`WORDS` in their name, that with the most actuated joints before it, at least three.
4. The last body of the longest chain of actuated joints. Where fingers branch off an arm, the body that carries them.
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.parsers import expat

import mujoco

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


_HINGE, _SLIDE = mujoco.mjtJoint.mjJNT_HINGE.value, mujoco.mjtJoint.mjJNT_SLIDE.value
_ON_JOINT = (mujoco.mjtTrn.mjTRN_JOINT.value, mujoco.mjtTrn.mjTRN_JOINTINPARENT.value)


@dataclass(frozen=True, slots=True)
class JointDrive:
    """One actuator on one joint.

    Attributes:
        actuator: its index, None for one that the model does not have.
        factor: command of a position servo for one radian or metre of the joint.
        offset: its command for the joint's zero.
        kind: ``position servo``, or what else it is.
    """

    actuator: int | None
    factor: float
    offset: float
    kind: str

    @property
    def servo(self) -> bool:
        """True where a command is a position."""
        return self.kind == POSITION


POSITION = "position servo"


def is_servo(model: Any, index: int) -> bool:
    """Return True for a position servo: its bias pulls back with its length."""
    return actuator_kind(model, index) == POSITION


def servo_line(model: Any, index: int) -> tuple[float, float]:
    """Return offset and slope of the command by which a servo keeps its length.

    Its force is gain * command + bias[0] + bias[1] * length, and zero where it stands.
    """
    gain, (constant, pull) = float(model.actuator_gainprm[index][0]), model.actuator_biasprm[index][:2]
    return (-float(constant) / gain, -float(pull) / gain) if gain else (0.0, 1.0)


def actuator_kind(model: Any, index: int) -> str:
    """Return what an actuator's command is, by its dynamics, gain and bias."""
    dynamics, gain, bias = (
        int(each[index]) for each in (model.actuator_dyntype, model.actuator_gaintype, model.actuator_biastype)
    )
    if mujoco.mjtDyn.mjDYN_MUSCLE.value == dynamics or mujoco.mjtGain.mjGAIN_MUSCLE.value == gain:
        return "muscle"
    if int(model.actuator_trntype[index]) == mujoco.mjtTrn.mjTRN_BODY.value:
        return "adhesion"
    if dynamics == mujoco.mjtDyn.mjDYN_INTEGRATOR.value:
        return "velocity servo"
    if gain != mujoco.mjtGain.mjGAIN_FIXED.value or model.actuator_gainprm[index][0] == 0:
        return "general actuator"
    if bias == mujoco.mjtBias.mjBIAS_NONE.value:
        return "torque motor"
    pull, brake = (float(value) for value in model.actuator_biasprm[index][1:3])
    if bias == mujoco.mjtBias.mjBIAS_AFFINE.value and pull < 0:
        return POSITION
    return "velocity servo" if brake < 0 else "general actuator"


def drives(model: Any) -> dict[int, JointDrive]:
    """Return the actuator of each hinge or slide by the joint's index.

    A position servo precedes other actuators of its joint. An actuator of a tendon counts where that is of one joint.
    A model without actuators describes an arm that has its own: each joint counts as a position servo.
    """
    if not model.nu:
        single = (each for each in range(model.njnt) if int(model.jnt_type[each]) in (_HINGE, _SLIDE))
        return {joint: JointDrive(None, 1.0, 0.0, POSITION) for joint in single}
    found: dict[int, JointDrive] = {}
    for index in range(model.nu):
        joint, ratio = _joint(model, index)
        if joint < 0 or not ratio or int(model.jnt_type[joint]) not in (_HINGE, _SLIDE):
            continue
        offset, slope = servo_line(model, index)
        drive = JointDrive(index, slope * ratio, offset, actuator_kind(model, index))
        if joint not in found or (drive.servo and not found[joint].servo):
            found[joint] = drive
    return found


def _joint(model: Any, index: int) -> tuple[int, float]:
    """Return an actuator's joint, -1 for none, and its length per radian or metre."""
    kind, target = int(model.actuator_trntype[index]), int(model.actuator_trnid[index][0])
    gear = float(model.actuator_gear[index][0])
    if kind in _ON_JOINT:
        return target, gear
    if kind == mujoco.mjtTrn.mjTRN_TENDON.value and int(model.tendon_num[target]) == 1:
        wrap = int(model.tendon_adr[target])
        if int(model.wrap_type[wrap]) == mujoco.mjtWrap.mjWRAP_JOINT.value:
            return int(model.wrap_objid[wrap]), gear * float(model.wrap_prm[wrap])
    return -1, 0.0


WORDS = frozenset({"tip", "tcp", "ee", "eef", "effector", "pinch", "grip", "gripper", "attachment"})
"""Words of a site's name that make it a tip; names are split at everything but letters and digits."""

ARM_JOINTS_MIN = 3
"""Fewest joints that place a tip at a point."""

FINGER_JOINTS_MAX = 5
"""Most joints of a finger."""

_NAMES_SHOWN = 12

_SINGLE = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
_JOINT_TRANSMISSIONS = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)


@dataclass(frozen=True)
class _Node:
    """One body, and how many actuated joints lead to it."""

    body: Any
    joints: int
    jointed: bool
    children: tuple[_Node, ...]

    @property
    def below(self) -> int:
        """Actuated joints of its longest branch below it."""
        return max((child.joints + child.below - self.joints for child in self.children), default=0)

    def nodes(self) -> Iterator[_Node]:
        yield self
        for child in self.children:
            yield from child.nodes()

    @property
    def moves(self) -> bool:
        return any(node.jointed for node in self.nodes())


def mark_tip(spec: Any, tip: str = "") -> str:
    """Return the name of the tip's site, which is added where the tip is a body.

    Args:
        spec: the model, which is changed.
        tip: name of a site or a body; empty for the rule of this module.

    Returns:
        The site's name; empty for a model without a site for it and without an actuated joint.

    Raises:
        ValidationError: the model has no site and no body called ``tip``.
    """
    actuated = {each.target for each in spec.actuators if each.trntype in _JOINT_TRANSMISSIONS}
    tree = _tree(spec.worldbody, 0, actuated if spec.actuators else None)
    if tip:
        return _named(tree, tip)
    sites = [(node, str(site.name)) for node in tree.nodes() for site in node.body.sites]
    for _, name in sites:
        if name.endswith("gripper_tip"):
            return name
    worded = [(node.joints, name) for node, name in sites if WORDS & set(re.split(r"[^a-z0-9]+", name.lower()))]
    joints, name = max(worded, key=lambda each: each[0], default=(0, ""))
    if joints >= ARM_JOINTS_MIN:
        return name
    end = _end(tree)
    return "" if end is None else _site_of(end.body, {name for _, name in sites})


def _tree(body: Any, joints: int, actuated: set[str] | None) -> _Node:
    own = [joint for joint in body.joints if joint.type in _SINGLE]
    joints += sum(actuated is None or joint.name in actuated for joint in own)
    return _Node(body, joints, bool(own), tuple(_tree(child, joints, actuated) for child in body.bodies))


def _end(tree: _Node) -> _Node | None:
    """Return the end of the longest actuated chain, or what carries its fingers."""
    node = tree
    if not node.below:
        return None
    while node.below:
        fingers = sum(child.moves for child in node.children) > 1 and node.below <= FINGER_JOINTS_MAX
        if fingers and node.joints >= ARM_JOINTS_MIN and node.joints > node.below:
            break
        node = max(node.children, key=lambda child: child.joints + child.below)
    return node


def _named(tree: _Node, tip: str) -> str:
    sites = {str(site.name) for node in tree.nodes() for site in node.body.sites}
    if tip in sites:
        return tip
    bodies = [node.body for node in tree.nodes()][1:]
    body = next((each for each in bodies if each.name == tip), None)
    if body is None:
        known = [*sorted(sites - {""}), *(str(each.name) for each in bodies if each.name)]
        more = f" and {len(known) - _NAMES_SHOWN} more" if len(known) > _NAMES_SHOWN else ""
        raise ValidationError(
            f"tip must be a site or a body of the model ({', '.join(known[:_NAMES_SHOWN])}{more}), not {shown(tip)}."
        )
    return _site_of(body, sites)


def _site_of(body: Any, taken: set[str]) -> str:
    name = "tip"
    while name in taken:
        name += "_"
    body.add_site(name=name)
    return name
