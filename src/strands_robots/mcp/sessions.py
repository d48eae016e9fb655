"""Sessions of the HTTP server, within bounds: the SDK ends none by itself.

A session in which a request is open, a stream or a call, is never ended here. Its end halts nothing: what its client
holds and moves ends with the client's leases, which last shorter than an idle session.
"""

# mypy: disable-error-code="misc"
from __future__ import annotations

import time
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

from strands_robots.mcp._compat import end_session
from strands_robots.serving.verbs import TTL_MAX_S

IDLE_S = TTL_MAX_S + 300.0
"""Seconds without a request after which a session is ended; every lease of its client has ended before."""

TOKEN_MAX = 32
"""Sessions of one token; beyond it the idle one that is missed least is ended."""

TOTAL_MAX = 256
"""Sessions of all tokens; beyond it one of the token that has the most is ended."""


@dataclass
class _Session:
    owner: str
    used_at: float = field(default_factory=time.monotonic)
    uses: int = 1
    open: int = 0


class Sessions:
    """Sessions that the SDK's manager keeps, by id.

    Args:
        manager: the SDK's ``StreamableHTTPSessionManager``.
    """

    def __init__(self, manager: Any) -> None:
        self.manager = manager
        self._sessions: dict[str, _Session] = {}

    def __len__(self) -> int:
        return len(self._sessions)

    def begin(self, session_id: str, owner: str) -> None:
        """Note a request in a session that is the owner's."""
        session = self._sessions.get(session_id)
        if session is not None and session.owner == owner:
            session.open += 1
            session.uses += 1

    def end(self, session_id: str, owner: str) -> None:
        """Note the end of that request."""
        session = self._sessions.get(session_id)
        if session is not None and session.owner == owner:
            session.open -= 1
            session.used_at = time.monotonic()

    async def opened(self, session_id: str, owner: str) -> None:
        """Keep a new session; an idle one may be ended for it."""
        self._sessions[session_id] = _Session(owner)
        counts = Counter(each.owner for each in self._sessions.values())
        if counts[owner] > TOKEN_MAX:
            await self._end_one(owner, session_id)
        elif len(self._sessions) > TOTAL_MAX:
            await self._end_one(counts.most_common(1)[0][0], session_id)

    async def close(self, session_id: str) -> None:
        """End a session."""
        self._sessions.pop(session_id, None)
        await end_session(self.manager, session_id)

    async def close_idle(self) -> None:
        """End the sessions that nobody has used for long."""
        before = time.monotonic() - IDLE_S
        for session_id, session in tuple(self._sessions.items()):
            if not session.open and session.used_at < before:
                await self.close(session_id)

    async def _end_one(self, owner: str, new: str) -> None:
        idle = {
            session_id: (each.uses > 1, each.used_at)
            for session_id, each in self._sessions.items()
            if each.owner == owner and not each.open and session_id != new
        }
        if idle:
            # One that was never used after its beginning goes first, so that a flood of them ends no client's.
            await self.close(min(idle, key=lambda each: idle[each]))
