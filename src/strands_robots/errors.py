"""The root of every exception that this package raises on purpose."""

from __future__ import annotations


class StrandsRobotsError(Exception):
    """Base of all public exceptions of ``strands_robots``.

    A subclass keeps the built-in base that callers know it by: :class:`~strands_robots.utils.ValidationError` is a
    ``ValueError`` as well, a policy's failure a ``RuntimeError``. Exceptions are raised inside the package; an agent or
    a network peer sees an error envelope (:mod:`strands_robots.envelope`) instead.
    """
