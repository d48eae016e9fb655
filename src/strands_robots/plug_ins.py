"""Robots, teleoperators and policies of other packages, by entry point.

A package states them in its metadata, which is read without importing it::

    [project.entry-points."strands_robots.robots"]
    turntable = "my_package:Turntable"

Its code is imported when the part is asked for by its name, and not before. The names of built-in parts cannot be
taken, and a name that two packages state is refused.

Source: packaging.python.org, "Entry points specification".
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from strands_robots.utils import ValidationError, shown


@dataclass(frozen=True, slots=True)
class PlugIn:
    """One part of another package: its kind, its name and the package."""

    kind: str
    name: str
    package: str
    """Distribution with its version, such as ``my-robot 1.0``."""

    entry: EntryPoint

    def __str__(self) -> str:
        return f"{self.kind} {self.name} of {self.package}"

    def load(self) -> Callable[..., Any]:
        """Import and return the callable that makes the part.

        Raises:
            ValidationError: the package is broken; the message names it and its error.
        """
        try:
            factory = self.entry.load()
        except BaseException as exc:
            if isinstance(exc, KeyboardInterrupt | GeneratorExit):
                raise
            # A module may raise anything at its import, SystemExit too.
            raise ValidationError(f"{self} cannot be loaded: {_problem(exc)}.") from exc
        if not callable(factory):
            raise ValidationError(f"{self} must be a callable that makes one, not {shown(factory)}.")
        made: Callable[..., Any] = factory
        return made

    def make(self, **options: Any) -> Any:
        """Make the part with the options that were given.

        Raises:
            ValidationError: an option that it does not take, or an error of the package's; the message names both.
            ConnectionError: it could not be connected.
        """
        factory = self.load()
        if problem := _unbound(factory, options):
            raise ValidationError(f"{self} cannot be made: {problem}.")
        try:
            return factory(**options)
        except (ValidationError, ConnectionError):
            raise
        except Exception as exc:
            raise ValidationError(f"{self} cannot be made: {_problem(exc)}.") from exc


class PlugIns:
    """Parts of one kind that installed packages state.

    Args:
        kind: robot, teleoperator or policy; the group is ``strands_robots.`` and its plural.
        built_in: names that no package can take.
    """

    def __init__(self, kind: str, built_in: Collection[str]) -> None:
        self.kind = kind
        self.group = f"strands_robots.{kind[:-1]}ies" if kind.endswith("y") else f"strands_robots.{kind}s"
        self.built_in = frozenset(built_in)

    def names(self) -> tuple[str, ...]:
        """Return the names that can be asked for, sorted; nothing is imported."""
        return tuple(sorted(self._stated().keys() - self.built_in))

    def get(self, name: object) -> PlugIn | None:
        """Return the part of that name, not imported.

        None for a built-in or unknown name.

        Raises:
            ValidationError: two packages state the name.
        """
        stated = self._stated().get(name, []) if isinstance(name, str) and name not in self.built_in else []
        if len(stated) > 1:
            packages = " and ".join(each.package for each in stated)
            raise ValidationError(f"{self.kind} {name} is stated by {packages}; uninstall all of them but one.")
        return stated[0] if stated else None

    def makes(self, target: str) -> bool:
        """Return True for the ``module:NAME`` of a stated part; nothing is imported."""
        return any(part.entry.value == target for parts in self._stated().values() for part in parts)

    def refused(self) -> Mapping[str, str]:
        """Return the names that cannot be asked for, and the reason."""
        reasons = {}
        for name, stated in self._stated().items():
            packages = " and ".join(each.package for each in stated)
            if name in self.built_in:
                reasons[name] = f"{packages} cannot take the name of a built-in {self.kind}"
            elif len(stated) > 1:
                reasons[name] = f"stated by {packages}"
        return reasons

    def _stated(self) -> dict[str, list[PlugIn]]:
        stated: dict[str, list[PlugIn]] = {}
        for entry in entry_points(group=self.group):
            package = "a package" if entry.dist is None else f"{entry.dist.name} {entry.dist.version}"
            parts = stated.setdefault(entry.name, [])
            # A package that lies twice on the path states each of its names twice.
            if all((each.package, each.entry.value) != (package, entry.value) for each in parts):
                parts.append(PlugIn(self.kind, entry.name, package, entry))
        return stated


def takes(factory: Callable[..., Any], option: str) -> bool:
    """Return True for a callable that takes ``option`` by name."""
    try:
        parameters = inspect.signature(factory).parameters.values()
    except (TypeError, ValueError):
        return False
    return any(each.name == option or each.kind is each.VAR_KEYWORD for each in parameters)


def _unbound(factory: Callable[..., Any], options: Mapping[str, Any]) -> str:
    """Return why the callable does not take these options, or nothing."""
    try:
        signature = inspect.signature(factory)
    except (TypeError, ValueError):
        return ""
    try:
        signature.bind(**options)
    except TypeError as exc:
        known = ", ".join(name for name in signature.parameters) or "none"
        return f"{exc}; its options are {known}"
    return ""


def _problem(exc: BaseException) -> str:
    return f"{type(exc).__name__}: {' '.join(str(exc).split())}".removesuffix(": ").rstrip(".")
