"""Pictures for the user of a client on this machine."""

from __future__ import annotations

from pathlib import Path
from urllib.parse import urlparse

from strands_robots.mcp.caller import PictureFiles


def open_files() -> set[str]:
    """Return the files that this process has open, by what their descriptors point to."""
    found = set()
    for each in Path("/proc/self/fd").iterdir():
        try:
            found.add(str(each.readlink()))
        except FileNotFoundError:  # the descriptor of the listing itself
            continue
    return found


def test_shown_pictures_leave_no_file_open() -> None:
    pictures = PictureFiles()
    shown = [Path(urlparse(pictures.show(b"jpeg %d" % number)).path) for number in range(3 * PictureFiles.FILES_MAX)]
    folder = str(shown[0].parent)
    assert not [each for each in open_files() if each.startswith(folder)]
    assert [each.exists() for each in shown] == [False] * 2 * PictureFiles.FILES_MAX + [True] * PictureFiles.FILES_MAX
    assert shown[-1].read_bytes() == b"jpeg 23"
    pictures.close()
    assert not shown[-1].exists()
