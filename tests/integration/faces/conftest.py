"""Robots of a file on one network after the other, and faces that reach them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack

import pytest
from fixtures.face_robots import NETWORKS, OURS, FaceSite
from fixtures.faces import FACES, Face
from tests.conftest import threads_ended


@pytest.fixture(autouse=True, scope="module")
def no_thread_of_ours_left() -> Iterator[None]:
    """Threads of a face, which a file keeps open, have ended at the end of the file."""
    with threads_ended():
        yield


@pytest.fixture(scope="module", params=NETWORKS)
def site(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[FaceSite]:
    """The robots of the file, ``ROBOTS`` of its module, on one network alone."""
    robots = getattr(request.module, "ROBOTS", OURS)
    made = FaceSite(tmp_path_factory.mktemp("site"), request.param, robots)
    with pytest.MonkeyPatch.context() as patch:
        for name, value in made.settings.items():
            patch.setenv(name, value)
        yield made
    made.close()


@pytest.fixture(autouse=True)
def same_state(site: FaceSite, monkeypatch: pytest.MonkeyPatch) -> None:
    """Have faces of this process use the state of the site's machine in each test."""
    monkeypatch.setenv("STRANDS_STATE_DIR", site.settings["STRANDS_STATE_DIR"])


@pytest.fixture(scope="module", params=list(FACES))
def face(request: pytest.FixtureRequest, site: FaceSite) -> Iterator[Face]:
    """One face, open for all tests of the file."""
    with ExitStack() as stack:
        yield FACES[request.param](site, stack)
