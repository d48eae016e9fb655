"""Decorator of agent tools; its import fails with the extra's name without it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from strands_robots.utils import ValidationError, missing_extra, shown

try:
    from strands import ToolContext, tool
except ModuleNotFoundError as exc:
    if (exc.name or "").partition(".")[0] != "strands":
        raise
    raise missing_extra("An agent's tool", "agent") from exc

__all__ = ["ToolContext", "fitted", "strict", "tool"]

T = TypeVar("T", bound=Any)


def fitted(agent_tool: T, fit: Callable[[dict[str, Any]], dict[str, Any]]) -> T:
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
