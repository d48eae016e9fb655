"""Sources of robot models: built-in, files, and ``robot_descriptions``."""

from __future__ import annotations

import importlib
import importlib.util
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from strands_robots.kinematics.model_file import load_model
from strands_robots.utils import ValidationError, alike, shown

MODELS = Path(__file__).parents[1] / "models"
BUILT_IN = ("so100", "so101", "rover")
"""Models that come with the package; nothing is downloaded for them."""

ALIASES = {
    "so_arm100": "so100",
    "so-100": "so100",
    "so100_follower": "so100",
    "so_arm101": "so101",
    "so-101": "so101",
    "so101_follower": "so101",
}

_SUFFIXES = (".xml", ".mjcf", ".urdf")


@dataclass(frozen=True, slots=True)
class ModelSource:
    """A model's label and its file."""

    label: str
    path: Path

    def load(self) -> Any:
        """Return a fresh ``MjSpec``. Raises :class:`ValidationError` with the reason."""
        return load_model(self.path, self.label)


def find(model: object) -> ModelSource:
    """Return the source of a built-in name, a file, or a ``robot_descriptions`` name.

    Raises:
        ValidationError: no such model; the message names similar ones.
    """
    if isinstance(model, Path):
        model = str(model)
    if not isinstance(model, str) or not model.strip() or len(model) > 4096 or "\0" in model:
        raise ValidationError(f"model must be a model's name or the path of an MJCF or URDF file, not {shown(model)}.")
    name = ALIASES.get(model.lower(), model.lower())
    if name in BUILT_IN:
        return ModelSource(name, MODELS / f"{name}.xml")
    if model.lower().endswith(_SUFFIXES) or "/" in model:
        return _find_file(model)
    return _find_description(model)


def _find_file(model: str) -> ModelSource:
    path = Path(model).expanduser()
    if not path.is_file():
        raise ValidationError(f"model must be an existing MJCF or URDF file; there is no {shown(model)}.")
    if path.suffix.lower() not in _SUFFIXES:
        raise ValidationError(f"model must end in {', '.join(_SUFFIXES)}, not {shown(model)}.")
    return ModelSource(path.stem, path)


def _find_description(model: str) -> ModelSource:
    names = _description_names()
    for candidate in (model, f"{model}_mj_description", f"{model}_description"):
        if candidate in names:
            # Importing one of these modules fetches the description unless its cache has it.
            try:
                module = importlib.import_module(f"robot_descriptions.{candidate}")
            except Exception as exc:  # that package clones with git, whose failures have no common type
                raise ValidationError(f"model {shown(model)} cannot be fetched: {_first_line(exc)}") from exc
            path = getattr(module, "MJCF_PATH", None) or getattr(module, "URDF_PATH", None)
            if isinstance(path, str):
                return ModelSource(model, Path(path))
    similar = alike(model.lower(), [*BUILT_IN, *ALIASES, *names], most=5)
    hint = f"near it: {', '.join(similar)}" if similar else f"known: {', '.join(BUILT_IN)}"
    raise ValidationError(f"model {shown(model)} is not known; {hint}. A path to an MJCF or URDF file works too.")


def _description_names() -> list[str]:
    if importlib.util.find_spec("robot_descriptions") is None:
        return []
    return sorted(importlib.import_module("robot_descriptions").DESCRIPTIONS)


def _first_line(exc: BaseException) -> str:
    text = " ".join(str(exc).split())
    return text[:300] or type(exc).__name__
