"""Forms of verbs, made of what robots say about themselves."""

from __future__ import annotations

import json
from typing import Any

import pytest
from fixtures.page_feed import forms_of

from strands_robots.serving.arm_verbs import ARM_MOTION_VERBS
from strands_robots.serving.verbs import described


@pytest.mark.parametrize("default", [float("nan"), float("inf"), -float("inf"), [1], {}])
def test_default_that_a_page_cannot_be_told_is_left_out(default: Any) -> None:
    forms = forms_of([{"name": "wave", "parameters": {"properties": {"speed": {"default": default}}}}])
    assert json.loads(json.dumps(forms, allow_nan=False))[0]["parameters"][0]["default"] is None


def test_form_names_units_choices_and_the_fields_that_are_shown_of_every_arm_verb() -> None:
    forms = {form["name"]: form for form in forms_of([described(verb) for verb in ARM_MOTION_VERBS.values()])}
    fields = {name: {each["name"]: each for each in form["parameters"]} for name, form in forms.items()}
    assert [name for name, each in fields["pick"].items() if each["shown"]] == ["object", "speed"]
    assert fields["pick"]["object"]["choices"] == fields["place"]["on"]["choices"] == "objects"
    assert fields["pick"]["picture"]["choices"] == "cameras"
    assert fields["moveJoints"]["joints"]["choices"] == "joints"
    assert [fields["moveTo"][name]["unit"] for name in ("x", "approach", "speed")] == ["m", "\u00b0", ""]


BREW: dict[str, Any] = {
    "name": "brewCoffee",
    "description": "Brew coffee.\n\nArgs:\n    cups: how many",
    "parameters": {
        "properties": {
            "cups": {"type": "integer", "minimum": 1, "maximum": 8, "unit": "cups"},
            "strength": {"type": "string", "enum": ["mild", "strong"], "default": "mild"},
            "lease_id": {"type": "string"},
        },
        "required": ["cups"],
    },
    "labels": {"direction": "write", "own": "true", "lasts_s": "90"},
}


def test_own_verb_has_a_form_with_its_domains_that_says_whose_it_is() -> None:
    brew, pick = forms_of(
        [BREW, {"name": "pick"}, {"name": "resume", "parameters": {"properties": {"assertion": {"type": "object"}}}}]
    )
    assert (brew["own"], brew["kind"], brew["lasts_s"], brew["summary"]) == (True, "motion", 90.0, "Brew coffee.")
    cups, strength = brew["parameters"]
    assert (cups["low"], cups["high"], cups["unit"], cups["enum"]) == (1, 8, "cups", [])
    assert (strength["enum"], strength["default"], strength["required"]) == (["mild", "strong"], "mild", False)
    assert not pick["own"]


def test_stops_of_a_device_that_is_none_of_ours_say_that_they_are_its_own() -> None:
    assert all(form["own"] for form in forms_of([{"name": name} for name in ("halt", "stop", "STOP ALL")]))


def test_forms_of_a_hostile_description_are_bounded_plain_text() -> None:
    deep: dict[str, Any] = {}
    for _ in range(500):
        deep = {"properties": {"a": deep}, "items": [deep]}
    attack = "<script>alert(1)</script>\x1b]0;owned\x07"
    many = [{**BREW, "name": f"verb{n}", "description": attack, "parameters": deep} for n in range(10_000)]
    forms = forms_of([*many, {"name": 5}, {"name": "x", "parameters": {"properties": {"a": 5}, "required": 3}}])
    assert len(forms) == 100
    assert forms[0]["summary"] == "<script>alert(1)</script>"
    assert len(json.dumps(forms, allow_nan=False)) < 100_000
