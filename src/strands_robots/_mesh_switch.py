"""The kill switch ``STRANDS_MESH``, read before the mesh is loaded."""

from __future__ import annotations

import logging

from strands_robots import settings

logger = logging.getLogger(__name__)

_REQUESTS = {"false": False, "0": False, "no": False, "true": True, "1": True, "yes": True}
_warned: set[str] = set()


def mesh_env_request() -> bool | None:
    """Return False for false, 0 and no, True for true, 1 and yes, else None.

    Any other value is ignored, with one warning.
    """
    value = settings.raw("STRANDS_MESH").lower()
    if value and value not in _REQUESTS and value not in _warned:
        _warned.add(value)
        logger.warning("STRANDS_MESH=%r is neither true nor false; it is ignored.", value)
    return _REQUESTS.get(value)
