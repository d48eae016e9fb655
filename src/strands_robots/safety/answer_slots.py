"""Slots of a question, by which the processes of one machine share its answers.

On a machine with hundreds of processes an answer is heard by all of them only after as many have given one. So a
process first takes one of three slots of a question: a file that only its first maker makes.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import time
from collections.abc import Iterable, Sequence
from pathlib import Path

from strands_robots.state_files import StateFileError, make_private, require_private, state_dir
from strands_robots.stop_log import stop_logger

logger = stop_logger(__name__)

SLOTS = 3
OLD_S = 5.0
"""Age in s from which a slot is removed: its question was answered or is asked anew, under another id."""

SWEPT_ABOVE = 64
"""Slots in the directory from which old ones are looked for."""


class AnswerSlots:
    """Slots in ``answers`` of the state directory.

    Args:
        state: in place of the state directory.
    """

    def __init__(self, state: Path | None = None) -> None:
        self._state = state

    def take(self, nonces: Sequence[str], epochs: Iterable[str]) -> list[str]:
        """Take a free slot of each of these questions; return those that had one.

        All, where the directory cannot be used: answers too many are better than none.

        Args:
            nonces: ids of questions, 32 hex digits.
            epochs: of the stops that would be answered; processes with other stops do not share a slot.
        """
        root = self._state or state_dir()
        folder = root / "answers"
        stops = hashlib.sha256(",".join(sorted(epochs)).encode("utf-8", "replace")).hexdigest()[:8]
        try:
            if not folder.exists():
                make_private(folder)
            require_private(folder, root)
            taken = frozenset(each.name for each in folder.iterdir())
            if len(taken) > SWEPT_ABOVE:
                _sweep(folder)
            return [nonce for nonce in nonces if _made(folder, f"{nonce}-{stops}", taken)]
        except (OSError, StateFileError) as exc:
            logger.warning("The processes of this machine cannot share their answers: %s", exc)
            return list(nonces)


def _made(folder: Path, name: str, taken: frozenset[str]) -> bool:
    for number in range(SLOTS):
        if f"{name}-{number}" in taken:
            continue
        with contextlib.suppress(FileExistsError):
            os.close(os.open(folder / f"{name}-{number}", os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600))
            return True
    return False


def _sweep(folder: Path) -> None:
    for path in folder.iterdir():
        with contextlib.suppress(OSError):  # another process removed it
            if abs(time.time() - path.lstat().st_mtime) > OLD_S:
                path.unlink()
