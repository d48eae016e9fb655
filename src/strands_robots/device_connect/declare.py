"""The framework's decorators, with types: what a method declares stays the method it is."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any, TypeVar, cast

from device_connect_edge import drivers

F = TypeVar("F", bound=Callable[..., Any])
Labels = dict[str, str | list[str]]


def rpc(labels: Labels | None = None) -> Callable[[F], F]:
    """A function that agents may call; its name, hints and docstring become the schema they read."""
    return cast(Callable[[F], F], drivers.rpc(labels=labels))


def emit(labels: Labels | None = None) -> Callable[[F], F]:
    """An event: calling the method emits it."""

    def declared(method: F) -> F:
        # The framework asks for the signature at every emission; one that is stated costs nothing to find.
        vars(method)["__signature__"] = inspect.signature(method)
        return cast(F, drivers.emit(labels=labels)(method))

    return declared


def on(event_name: str) -> Callable[[F], F]:
    """A handler of an event of every device of the tenant, our own included."""
    return cast(Callable[[F], F], drivers.on(event_name=event_name))
