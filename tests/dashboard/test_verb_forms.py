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


def test_form_names_units_choices_and_the_fields_that_are_shown_of_every_arm_verb() -> None:
    from strands_robots.dashboard.verb_forms import peer_forms  # noqa: PLC0415 - beside what it holds to its words
    from strands_robots.serving.arm_motion_verbs import ARM_MOTION_VERBS  # noqa: PLC0415 - the descriptions as they are

    forms = {form["name"]: form for form in peer_forms(ARM_MOTION_VERBS.values())}
    fields = {name: {each["name"]: each for each in form["parameters"]} for name, form in forms.items()}
    assert [name for name, each in fields["pick"].items() if each["shown"]] == ["object", "speed"]
    assert fields["pick"]["object"]["choices"] == fields["place"]["on"]["choices"] == "objects"
    assert fields["pick"]["picture"]["choices"] == "cameras"
    assert fields["moveJoints"]["joints"]["choices"] == "joints"
    assert [fields["moveTo"][name]["unit"] for name in ("x", "approach", "speed")] == ["m", "\u00b0", ""]
