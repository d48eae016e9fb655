"""The switch STRANDS_MESH and the old module name of the mesh's session."""

from __future__ import annotations

import logging

import pytest

from strands_robots import _mesh_switch
from strands_robots.mesh import mesh_disabled_by_env


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        ("false", False),
        ("0", False),
        ("NO", False),
        ("true", True),
        ("1", True),
        ("Yes", True),
        ("", None),
        (" ", None),
    ],
)
def test_switch_is_read_in_each_spelling(monkeypatch: pytest.MonkeyPatch, value: str, expected: bool | None) -> None:
    monkeypatch.setenv("STRANDS_MESH", value)
    assert _mesh_switch.mesh_env_request() is expected
    assert mesh_disabled_by_env() is (expected is False)


def test_any_other_value_is_ignored_with_one_warning(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("STRANDS_MESH", "flase")
    with caplog.at_level(logging.WARNING):
        assert _mesh_switch.mesh_env_request() is None
        assert _mesh_switch.mesh_env_request() is None
    assert len([record for record in caplog.records if "flase" in record.getMessage()]) == 1


def test_mesh_session_is_the_old_name_of_mesh_dot_session() -> None:
    import strands_robots.mesh.session  # noqa: PLC0415 - both names are what is tested
    import strands_robots.mesh_session  # noqa: PLC0415 - likewise

    assert strands_robots.mesh_session.get_session is strands_robots.mesh.session.get_session
