"""Decorator of agent tools; its import fails with the extra's name without it."""

from __future__ import annotations

from strands_robots.utils import missing_extra

try:
    from strands import ToolContext, tool
except ModuleNotFoundError as exc:
    if (exc.name or "").partition(".")[0] != "strands":
        raise
    raise missing_extra("An agent's tool", "agent") from exc

__all__ = ["ToolContext", "tool"]
