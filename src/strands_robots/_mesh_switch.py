"""What ``STRANDS_MESH`` asks for: off, on, or nothing."""

from __future__ import annotations

import logging

from strands_robots import settings

logger = logging.getLogger(__name__)

_REQUESTS = {"false": False, "0": False, "no": False, "true": True, "1": True, "yes": True}
_warned: set[str] = set()


def mesh_env_request() -> bool | None:
    """False for ``false``, ``0`` and ``no`` (the kill switch), True for ``true``, ``1`` and ``yes``, else None.

    Any other word is ignored, with one warning.
    """
    word = settings.raw("STRANDS_MESH").lower()
    if word and word not in _REQUESTS and word not in _warned:
        _warned.add(word)
        logger.warning("STRANDS_MESH=%r is neither true nor false; it is ignored.", word)
    return _REQUESTS.get(word)
