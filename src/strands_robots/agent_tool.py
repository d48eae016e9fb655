"""Decorator of agent tools; its import fails with the extra's name without it."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from inspect import signature
from typing import Any, TypeVar

from strands_robots.utils import ValidationError, missing_extra, shown

try:
    from strands import ToolContext, tool
except ModuleNotFoundError as exc:
    if (exc.name or "").partition(".")[0] != "strands":
        raise
    raise missing_extra("An agent's tool", "agent") from exc

__all__ = ["ToolContext", "fitted", "fitted_tool", "strict", "tool"]

T = TypeVar("T", bound=Any)
Fit = Callable[[dict[str, Any]], dict[str, Any]]


def fitted_tool(fit: Fit, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator that makes a tool whose input goes through ``fit`` first.

    It sees the input of an agent before its types are checked, and then the arguments of the call, as it sees those of
    a plain call in Python: an input may go through it twice.

    Args:
        fit: returns the arguments for those that it is given, by name.
        options: of ``strands.tool``.
    """

    def decorate(function: Callable[..., Any]) -> Any:
        names = tuple(signature(function).parameters)

        @wraps(function)
        def called(*values: Any, **given: Any) -> Any:
            return function(**fit({**dict(zip(names, values, strict=False)), **given}))

        return fitted(tool(**options)(called), fit)

    return decorate


def fitted(agent_tool: T, fit: Fit) -> T:
    """Return an agent tool whose input goes through ``fit`` before it is checked."""
    stream = agent_tool.stream

    def stream_fitted(tool_use: Any, *values: Any, **options: Any) -> Any:
        given = tool_use.get("input")
        return stream({**tool_use, "input": fit(given) if isinstance(given, dict) else given}, *values, **options)

    vars(agent_tool)["stream"] = stream_fitted
    return agent_tool


def strict(agent_tool: T) -> T:
    """Return an agent tool that refuses, by name, input that it would ignore."""
    takes = tuple(agent_tool.tool_spec["inputSchema"]["json"]["properties"])

    def known(given: dict[str, Any]) -> dict[str, Any]:
        unknown = ", ".join(shown(name) for name in given if name not in takes)
        if unknown:
            raise ValidationError(f"{agent_tool.tool_name} takes {', '.join(takes) or 'no arguments'}, not {unknown}.")
        return given

    return fitted(agent_tool, known)
