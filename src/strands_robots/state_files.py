"""State directory, with owner, mode and age of its files: lockouts, grants, keys.

A file counts only when it and every folder up to the state directory belong to this user and nobody else may write
them. What a program does with a file that does not count is its own: a robot comes up locked, a grant is void. Ages are
taken from the clock since boot, which nobody can set.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import stat
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

from strands_robots import settings
from strands_robots.errors import StrandsRobotsError
from strands_robots.stop_log import stop_logger

logger = stop_logger(__name__)

FILE_MAX_BYTES = 16 * 2**20
WRITABLE = 0o022
OPEN = 0o077

_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")


class StateFileError(StrandsRobotsError, ValueError):
    """A state file that does not count; the message names it and says why."""


def state_dir() -> Path:
    """Return the directory of the state files, ``STRANDS_STATE_DIR`` first."""
    stated = settings.raw("STRANDS_STATE_DIR")
    return Path(stated).expanduser() if stated else Path.home() / ".strands_robots"


def make_private(folder: Path) -> None:
    """Make ``folder`` and the parents that are missing, for this user alone."""
    # A mode does not reach the parents that mkdir makes by itself.
    missing = [each for each in (folder, *folder.parents) if not each.exists()]
    for each in reversed(missing):
        each.mkdir(mode=0o700, exist_ok=True)


def adopt(root: Path) -> None:
    """Close an empty state directory that this user made by hand and left open."""
    with contextlib.suppress(OSError):  # it is not there yet, or not this user's
        status = root.lstat()
        theirs = status.st_uid != os.getuid() or status.st_mode & stat.S_ISVTX
        if stat.S_ISDIR(status.st_mode) and status.st_mode & WRITABLE and not theirs and not any(root.iterdir()):
            root.chmod(0o700)
            logger.warning("%s was open to other users; it is this user's alone now.", root)


def read_private(
    path: Path,
    root: Path,
    *,
    forbidden: int = WRITABLE,
    longest: int = FILE_MAX_BYTES,
    error: type[StateFileError] = StateFileError,
) -> bytes:
    """Return the content of a file of this user in the state directory ``root``.

    Args:
        forbidden: mode bits that the file must not have: :data:`WRITABLE`, or :data:`OPEN` for a secret.
        error: what is raised.

    Raises:
        StateFileError: the file or a folder around it belongs to another user or is open to others.
        OSError: it is not there, is a link, or cannot be read.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC | os.O_NONBLOCK)
    with os.fdopen(descriptor, "rb") as file:
        _require_private_status(path, root, os.fstat(descriptor), forbidden, error)
        return file.read(longest)


def write_private(path: Path, content: bytes, *, once: bool = False) -> None:
    """Write a file of this user alone; it is whole and on the disk when this returns.

    Args:
        once: leave the file that another process wrote first.

    Raises:
        OSError: it cannot be written.
    """
    draft = path.with_name(f".{path.name}.{secrets.token_hex(8)}")
    descriptor = os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
    try:
        with os.fdopen(descriptor, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        if once:
            with contextlib.suppress(FileExistsError):
                os.link(draft, path)
        else:
            draft.replace(path)
    finally:
        draft.unlink(missing_ok=True)


def require_private_file(path: Path, root: Path, *, error: type[StateFileError] = StateFileError) -> int:
    """Check a secret file without opening it; return its inode.

    Closing a file would end the locks that SQLite holds on it for another thread of the process.

    Raises:
        StateFileError: as :func:`read_private`.
        OSError: it is not there.
    """
    status = path.lstat()
    _require_private_status(path, root, status, OPEN, error)
    return status.st_ino


def require_private(folder: Path, root: Path, *, error: type[StateFileError] = StateFileError) -> None:
    """Check ``folder`` and those around it up to ``root``.

    What is missing is made privately later.

    Raises:
        StateFileError: one of them belongs to another user, or others may write there.
    """
    around = [folder, *folder.parents]
    for each in around[: around.index(root) + 1] if root in around else around[:1]:
        with contextlib.suppress(FileNotFoundError):
            _require_own(each, each.stat(), WRITABLE, "write there; run chmod 700 on it", error)


def boot() -> str:
    """Return the id of this boot of the machine; empty where the system has none."""
    with contextlib.suppress(OSError):
        return _BOOT_ID.read_text(encoding="ascii").strip()
    return ""


_BOOT_CLOCK = getattr(time, "CLOCK_BOOTTIME", None)
uptime: Callable[[], float] = time.monotonic if _BOOT_CLOCK is None else partial(time.clock_gettime, _BOOT_CLOCK)
"""Returns seconds since boot, those asleep included where the system counts them; every write of a motion asks it."""


def _require_private_status(
    path: Path, root: Path, status: os.stat_result, forbidden: int, error: type[StateFileError]
) -> None:
    if not stat.S_ISREG(status.st_mode):
        raise error(f"{path} is no plain file.")
    _require_own(path, status, forbidden, "read or write it; run chmod 600 on it", error)
    require_private(path.parent, root, error=error)


def _require_own(path: Path, status: os.stat_result, forbidden: int, problem: str, error: type[StateFileError]) -> None:
    if status.st_uid != os.getuid():
        raise error(f"{path} belongs to uid {status.st_uid} and not to you (uid {os.getuid()}).")
    if stat.S_IMODE(status.st_mode) & forbidden:
        raise error(f"{path} has mode {stat.S_IMODE(status.st_mode):04o}: others may {problem}.")
