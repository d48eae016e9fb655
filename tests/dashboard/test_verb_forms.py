"""Forms of verbs, made of what robots say about themselves."""

from __future__ import annotations

import json
from typing import Any

import pytest

from strands_robots.dashboard.verb_forms import forms_of


@pytest.mark.parametrize("default", [float("nan"), float("inf"), -float("inf"), [1], {}])
def test_default_that_a_page_cannot_be_told_is_left_out(default: Any) -> None:
    forms = forms_of([{"name": "wave", "parameters": {"properties": {"speed": {"default": default}}}}])
    assert json.loads(json.dumps(forms, allow_nan=False))[0]["parameters"][0]["default"] is None
