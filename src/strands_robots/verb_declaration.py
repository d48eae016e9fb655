"""Verbs of a robot's own: the decorator ``@verb``, and what it declares.

    class Barista:
        @verb(motion=True, lasts=90.0)
        def brew_coffee(
            self,
            cups: Annotated[int, Domain(1, 8)],
            permit: Permit,
            strength: Literal["mild", "strong"] = "mild",
        ) -> dict[str, int]:
            \"\"\"Brew coffee.

            Args:
                cups: how many
                strength: of the coffee
            \"\"\"
            for cup in range(cups):
                if not permit.valid:
                    break
                ...

Hints and docstring are the description that callers read, on every network; arguments are checked by it before the
method is called. On the wire the verb is ``brewCoffee``. A ``permit`` is given to the method and never asked of its
caller: it is void after a stop, and the method then has to return.
"""

from __future__ import annotations

import functools
import inspect
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeVar, get_type_hints, overload

from strands_robots.safety.gate import MotionRequest, Permit, gate_of
from strands_robots.utils import DURATION_MAX_S, START_S, ValidationError, flag, number, plain_text, shown, text
from strands_robots.verb_parameters import Domain, Parameter, checked_arguments, is_permit, parameter_of

__all__ = ["DeclaredVerb", "Domain", "Permit", "declared_verbs", "verb"]

F = TypeVar("F", bound=Callable[..., Any])

NAME_MAX = 64
SUMMARY_MAX = 600

TIME_OVER = "its time was over before it was done"

MARK = "__strands_verb__"
"""Attribute by which a method is known as a verb."""

_NAME = re.compile(r"[a-z][A-Za-z0-9]*\Z")
_SECTION = re.compile(r"(Args|Arguments|Returns|Raises|Yields|Example|Examples|Note|Notes):\s*\Z")
_ENTRY = re.compile(r"(\w+)(?: ?\([^)]*\))?:\s*(.*)\Z")


@dataclass(frozen=True)
class DeclaredVerb:
    """A method that its robot declares as a verb.

    Attributes:
        function: as it was written.
        name: on the wire.
        motion: False for a read, and for a change.
        lasts: seconds that it may take to return.
        wrapper: the method that ``@verb`` made of the function.
        changes: it changes something and moves nothing.
    """

    function: Callable[..., Any]
    name: str
    motion: bool
    lasts: float
    wrapper: Callable[..., Any]
    changes: bool = False

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """Parameters that callers give, by the hints.

        Raises:
            ValidationError: a hint is missing, or is no type that a message can carry.
        """
        return tuple(
            parameter_of(
                f"{self.method}({each.name})", each, self._hint(each.name), self._sections[1].get(each.name, "")
            )
            for each in self._given
            if each.name != self.permit
        )

    @cached_property
    def permit(self) -> str:
        """The parameter that the permit is given by; empty without one.

        Raises:
            ValidationError: there are several.
        """
        names = [each.name for each in self._given if is_permit(self._hint(each.name))]
        if len(names) > 1:
            raise ValidationError(f"{self.method} takes one Permit, not {', '.join(names)}.")
        return names[0] if names else ""

    @property
    def method(self) -> str:
        """The method's name, for messages."""
        return self.function.__qualname__.rpartition("<locals>.")[2]

    @property
    def summary(self) -> str:
        """The first paragraph of the docstring, else the name."""
        return self._sections[0] or f"{self.name}."

    @property
    def returns(self) -> str:
        """Text of the docstring on the result."""
        return self._sections[2]

    def check(self) -> None:
        """Raise :class:`ValidationError` where the verb cannot be served."""
        if self.permit and not self.motion:
            raise ValidationError(f"{self.method} moves nothing (motion=False), and gets no Permit.")
        _ = self.parameters

    def carry_out(
        self, robot: object, arguments: Mapping[str, Any], request: MotionRequest | None = None
    ) -> tuple[Any, str, str]:
        """Call the method with checked arguments, and a permit where it takes one.

        Returns:
            Its result, how a motion ended: ``completed``, or ``stopped`` where its permit is void, and why it is void.

        Raises:
            MotionRefused: the robot is locked, was halted since the call was asked for, or one of its own verbs has
                not returned.
        """
        gate = gate_of(robot)
        if not self.motion:
            with gate.reading(self.name):
                return self.function(robot, **arguments), "", ""
        with gate.moving(self.name, START_S + self.lasts, request) as permit:
            given = {self.permit: permit} if self.permit else {}
            result = self.function(robot, **arguments, **given)
            if permit.valid:
                return result, "completed", ""
            return result, "stopped", "it was stopped" if permit.request.overtaken else TIME_OVER

    def called(self, robot: object, *values: object, **named: object) -> Any:
        """Do what a call of the method does: check its arguments, then carry it out.

        Raises:
            ValidationError: an argument outside its domain.
            MotionRefused: as :meth:`carry_out`.
        """
        # A verb that calls another one may pass its permit on; each is given its own of the same call.
        named.pop(self.permit, None)
        values = tuple(each for each in values if not isinstance(each, Permit))
        taken = [each for each in self.parameters if each.name not in named]
        if len(values) > len(taken):
            raise ValidationError(f"{self.method} takes at most {len(taken)} arguments in order, not {len(values)}.")
        given = {**{each.name: value for each, value in zip(taken, values, strict=False)}, **named}
        known = {each.name: each for each in self.parameters}
        return self.carry_out(robot, checked_arguments(known, given, self._unfit))[0]

    def _unfit(self, unknown: list[str], missing: list[str]) -> str:
        if unknown:
            takes = ", ".join(each.name for each in self.parameters) or "none"
            return f"{self.method} has no argument {shown(unknown[0])}; it takes {takes}."
        return f"{self.method} needs {', '.join(missing)}."

    @cached_property
    def _given(self) -> tuple[inspect.Parameter, ...]:
        own = list(inspect.signature(self.function).parameters.values())[1:]
        for each in own:
            if each.kind in (each.VAR_POSITIONAL, each.VAR_KEYWORD, each.POSITIONAL_ONLY):
                raise ValidationError(f"{self.method}: {each} has no name that a caller could give it by.")
            if each.name.startswith("_"):
                raise ValidationError(f"{self.method}: {each.name} begins with an underscore; give it another name.")
        return tuple(own)

    def _hint(self, name: str) -> Any:
        return self._hints.get(name)

    @cached_property
    def _hints(self) -> Mapping[str, Any]:
        try:
            return get_type_hints(self.function, include_extras=True)
        except Exception as exc:
            raise ValidationError(f"The type hints of {self.method} cannot be read: {exc}.") from exc

    @cached_property
    def _sections(self) -> tuple[str, dict[str, str], str]:
        return _read_docstring(inspect.getdoc(self.function) or "")


@overload
def verb(function: F) -> F: ...


@overload
def verb(*, motion: bool = True, name: str = "", lasts: float = 0.0, changes: bool = False) -> Callable[[F], F]: ...


def verb(
    function: F | None = None, *, motion: bool = True, name: str = "", lasts: float = 0.0, changes: bool = False
) -> F | Callable[[F], F]:
    """Declare a method as a verb of its robot, for every network and face.

    Args:
        function: the method, where the decorator is used without arguments.
        motion: True for what may move the robot: it passes lease, lockout and approval, and gets a :class:`Permit` by
            the parameter of that type. False for a read, which can obtain none.
        name: on the wire, in camelCase; made from the method's name by default.
        lasts: seconds that it may take to return, 0 to 3600, besides the 10 s that every motion has. After that its
            permit is void.
        changes: True, with ``motion=False``, for what moves nothing and is not for every caller, such as a setting:
            callers are authorized as for a motion, and lease, lockout and approval do not concern it.

    Raises:
        ValidationError: an argument outside its domain, or ``function`` is no plain method.
    """
    flag("motion", motion)
    if flag("changes", changes) and motion:
        raise ValidationError("changes=True goes with motion=False: a motion changes something anyway.")
    seconds = number("lasts", lasts, low=0.0, high=DURATION_MAX_S)

    def declare(method: F) -> F:
        if not inspect.isfunction(method):
            raise ValidationError(f"@verb declares a method, not {shown(method)}.")
        if (
            inspect.iscoroutinefunction(method)
            or inspect.isgeneratorfunction(method)
            or inspect.isasyncgenfunction(method)
        ):
            raise ValidationError(f"{method.__qualname__} must be a plain method: it is called on a thread of its own.")

        @functools.wraps(method)
        def call(self: object, *values: object, **named: object) -> Any:
            return declared.called(self, *values, **named)

        declared = DeclaredVerb(method, _wire_name(name, method.__name__), motion, seconds, call, changes)
        vars(call)[MARK] = declared
        return call  # type: ignore[return-value]  # the same signature, its permit left out by callers

    return declare if function is None else declare(function)


def declared_verbs(robot: object) -> dict[str, DeclaredVerb]:
    """Return the verbs that the class of a robot declares, by name on the wire.

    Raises:
        ValidationError: two verbs have one name, or a method overrides a verb without being declared.
    """
    found: dict[str, DeclaredVerb] = {}
    kind = type(robot).__name__
    for attribute, method in _methods(type(robot)):
        declared = _declared(method)
        if declared is None:
            raise ValidationError(f"{kind}.{attribute} overrides a verb; declare it with @verb, too.")
        if declared.wrapper is not method:
            # What stands above @verb would be left out when the verb is called over a network.
            raise ValidationError(f"{kind}.{attribute} has a decorator above @verb; put @verb above it.")
        other = next((each for name, each in found.items() if name.lower() == declared.name.lower()), None)
        if other is not None:
            names = f"{other.function.__name__} and {declared.function.__name__}"
            raise ValidationError(f"{kind} has two verbs {declared.name}: {names}; rename one.")
        found[declared.name] = declared
    return found


def _declared(value: object) -> DeclaredVerb | None:
    """Return what a function declares; no other attribute of a class is asked."""
    function = getattr(value, "__func__", None) if isinstance(value, staticmethod | classmethod) else value
    found = vars(function).get(MARK) if inspect.isfunction(function) else None
    return found if isinstance(found, DeclaredVerb) else None


def _methods(kind: type) -> Iterator[tuple[str, object]]:
    """Give the attributes of a class that it or a base declares as verbs."""
    seen: set[str] = set()
    for each in kind.__mro__:
        for attribute, value in vars(each).items():
            if attribute not in seen and _declared(value) is not None:
                seen.add(attribute)
                # Read off the classes: an attribute of the robot's own may be looked up anywhere.
                yield attribute, next(vars(base)[attribute] for base in kind.__mro__ if attribute in vars(base))


def _wire_name(stated: object, method: str) -> str:
    head, *rest = method.split("_")
    camel = head + "".join(part[:1].upper() + part[1:] for part in rest)
    name = text("name", stated, longest=NAME_MAX) if stated != "" else camel
    if not _NAME.match(name) or len(name) > NAME_MAX:
        source = f"name of {method}" if stated != "" else f"name made of {method}"
        raise ValidationError(
            f"the {source} must be camelCase of at most {NAME_MAX} letters and digits, not {shown(name)}."
        )
    return name


def _read_docstring(words: str) -> tuple[str, dict[str, str], str]:
    """Return the summary, the meanings of ``Args`` and the text of ``Returns``."""
    paragraphs: list[str] = []
    meanings: dict[str, str] = {}
    returns: list[str] = []
    section, entry, indent = "", "", 0
    for line in words.splitlines():
        heading = _SECTION.match(line)
        if heading is not None:
            section, entry = heading[1], ""
        elif not section:
            paragraphs.append(line)
        elif section.startswith("Arg") and line.strip():
            depth = len(line) - len(line.lstrip())
            match = _ENTRY.match(line.strip())
            if match is not None and (not entry or depth <= indent):
                entry, indent = match[1], depth
                meanings[entry] = match[2]
            elif entry:
                meanings[entry] += f" {line.strip()}"
        elif section == "Returns":
            returns.append(line)
    summary = "\n".join(paragraphs).strip().split("\n\n")[0]
    return (
        plain_text(summary, SUMMARY_MAX),
        {name: plain_text(meaning, SUMMARY_MAX) for name, meaning in meanings.items()},
        plain_text(" ".join(returns), SUMMARY_MAX),
    )
