"""Stops of one robot or one cell on the mesh, between real processes."""

from __future__ import annotations

from typing import Any

import pytest
from fixtures.waiting import eventually
from tests.integration.mesh.conftest import Join


@pytest.mark.parametrize(
    ("scope", "known", "stopped"),
    [
        ({"only": ["arm-1"]}, True, ("arm-1",)),
        ({"cell": "cell-1"}, True, ("arm-1", "nowhere")),
        ({"only": ["arm-9"]}, False, ("arm-1", "arm-2", "nowhere")),
    ],
    ids=str,
)
def test_stop_of_some_robots_leaves_the_others_alone(
    join: Join, scope: dict[str, Any], known: bool, stopped: tuple[str, ...]
) -> None:
    console, locked = join("console", "none"), set(stopped)
    cells = {"arm-1": "cell-1", "arm-2": "cell-2", "nowhere": ""}
    arms = {name: join(name, "arm", STRANDS_CELL=cell) for name, cell in cells.items()}
    console.sees(*arms)
    replies = console.ask("estop_some", scope, known)
    assert {each["responder_id"] for each in replies} == locked
    # A stop of a cell is published and sent; one of every robot is locked by what is published.
    eventually(lambda: {name for name, arm in arms.items() if arm.ask("epoch")} >= locked)
    assert {name for name, arm in arms.items() if arm.ask("epoch") or arm.ask("halts")[0]} == locked
