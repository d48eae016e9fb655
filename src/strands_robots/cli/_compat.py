"""All uses of private members of ``typer`` 0.29.

``tests/cli/test_cli_compat.py`` lists these members and fails when one of them changes. With a Typer that lacks them
nothing is changed.
"""

from __future__ import annotations

from typing import Any

import typer.core


def convert_when_needed() -> None:
    """Have Typer load pydantic only for a value that it has to convert.

    Typer builds a pydantic adapter for each parameter of a command, given or not, which is a third of the command's
    processor time.
    """
    build = getattr(typer.core, "build_runtime_param", None)
    if build is not None and not isinstance(build, _LazyConversions):
        vars(typer.core)["build_runtime_param"] = _LazyConversions(build)


class _LazyConversions:
    """Typer's ``build_runtime_param``, which builds at the first value that needs it."""

    def __init__(self, build: Any) -> None:
        self._build = build

    def __call__(self, descriptor: Any) -> _LazyConversion:
        return _LazyConversion(self._build, descriptor)


class _LazyConversion:
    """Conversion of the values of one parameter."""

    def __init__(self, build: Any, descriptor: Any) -> None:
        self._build, self._descriptor = build, descriptor
        self._built: Any = None

    def coerce(self, value: Any, param: Any, ctx: Any) -> Any:
        """Return the value that the command gets."""
        several = param.multiple or param.nargs == -1
        if value is None:
            return () if several else None
        if self._is_done(value):
            return list(value) if several else value
        if self._built is None:
            self._built = self._build(self._descriptor)
        return self._built.coerce(value, param=param, ctx=ctx)

    def _is_done(self, value: Any) -> bool:
        """Return True for what the adapter would give back as it is."""
        kind, info = self._descriptor.annotation, self._descriptor.parameter_info
        if info.parser is not None:
            return False
        if kind is str:
            return _plain(value)
        if kind == list[str]:
            return isinstance(value, list | tuple) and all(_plain(each) for each in value)
        return kind is float and type(value) is float and info.min is None and info.max is None


def _plain(value: object) -> bool:
    # Other text may hold what is no Unicode, which the adapter refuses.
    return type(value) is str and value.isascii()
