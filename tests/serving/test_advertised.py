"""Verbs as robots advertise them: what faces read of a description, however hostile it is."""

from __future__ import annotations

import json
import time
from typing import Any

import pytest

from strands_robots.serving.advertised import (
    AdvertisedVerb,
    absent_safety,
    find_verb,
    near,
    own_names,
    plain_data,
    typed,
    verbs_of,
)
from strands_robots.utils import ValidationError

BREW: dict[str, Any] = {
    "name": "brewCoffee",
    "description": "Brew coffee.\n\nArgs:\n    cups: how many",
    "parameters": {
        "type": "object",
        "properties": {
            "cups": {"type": "integer", "minimum": 1, "maximum": 8, "description": "How many", "unit": "cups"},
            "strength": {"type": "string", "enum": ["mild", "strong"], "default": "mild"},
            "name": {"type": "string"},
            "lease_id": {"type": "string"},
            "lease_ttl_s": {"type": "number"},
        },
        "required": ["cups"],
    },
    "labels": {"direction": "write", "safety": "critical", "own": "true", "lasts_s": "90"},
}
RESUME = {"name": "resume", "labels": {"direction": "write"}}


def brew() -> AdvertisedVerb:
    found = find_verb([RESUME, BREW], "brewCoffee")
    assert found is not None
    return found


def test_own_verb_is_read_with_its_domains_and_without_the_lease() -> None:
    verb = brew()
    assert (verb.summary, verb.reads, verb.own, verb.lasts_s) == ("Brew coffee.", False, True, 90.0)
    assert verb.takes == "cups: integer, 1 to 8 cups; [strength: mild | strong]; [name: string]"
    assert verb.leases == {"lease_id", "lease_ttl_s"}
    schema = verb.schema()
    assert list(schema["properties"]) == ["cups", "strength", "name"]
    assert schema["properties"]["cups"] == BREW["parameters"]["properties"]["cups"]
    assert schema["required"] == ["cups"]


def test_argument_that_a_verb_does_not_have_is_named_with_those_there_are() -> None:
    assert brew().unknown(["cups"]) == ""
    assert brew().unknown(["strenght"]) == (
        "brewCoffee takes no argument 'strenght'; its arguments: cups, strength, name."
    )
    assert "lease_id" in brew().unknown(["lease_id"]), "the server holds the lease"


@pytest.mark.parametrize(
    ("parameter", "text", "sent"),
    [
        ("cups", "5", 5),
        ("name", "5", "5"),
        ("name", '"1.5"', "1.5"),
        ("name", "null", "null"),
        ("strength", "strong", "strong"),
    ],
)
def test_typed_value_is_what_the_description_says(parameter: str, text: str, sent: object) -> None:
    assert typed(brew().by_name[parameter], parsed(text), text) == sent


@pytest.mark.parametrize(
    ("parameter", "text", "said"),
    [
        ("cups", "five", "cups must be a whole number, not 'five'."),
        ("cups", "1.5", "cups must be a whole number"),
        ("cups", "true", "cups must be a whole number"),
        ("cups", "9", "cups must be 1 to 8 cups, not 9."),
        ("strength", "weak", "strength must be one of mild, strong, not 'weak'."),
    ],
)
def test_value_that_does_not_fit_is_refused_by_name(parameter: str, text: str, said: str) -> None:
    with pytest.raises(ValidationError) as refused:
        typed(brew().by_name[parameter], parsed(text), text)
    assert said in str(refused.value)


def parsed(text: str) -> object:
    try:
        return json.loads(text)
    except ValueError:
        return text


def deep(levels: int) -> dict[str, Any]:
    schema: dict[str, Any] = {"type": "object"}
    for _ in range(levels):
        schema = {"type": "object", "properties": {"a": schema}, "items": [schema]}
    return schema


HOSTILE: list[Any] = [
    None,
    5,
    "functions",
    [None, 5, "x", [], {}, {"name": 5}, {"name": ""}, {"name": "\x1b[31mstop"}, {"name": "x" * 10_000}],
    [{**BREW, "parameters": each} for each in (None, 5, "x", [], {"properties": []}, {"properties": {"a": 5, 3: {}}})],
    [{**BREW, "labels": each} for each in (None, 5, [], {"direction": ["read"], "own": True, "lasts_s": 90})],
    [{**BREW, "labels": {"lasts_s": each}} for each in ("nan", "inf", "-5", "1e999", "9" * 5000, "x", "")],
    [{**BREW, "description": each} for each in (None, 5, ["x"], "a\x1b]0;owned\x07\u202eb\ud800", "x" * 10**6)],
    [
        {**BREW, "parameters": {"properties": {"a": each}, "required": required}}
        for each in (
            {"type": 5},
            {"type": [["x"]]},
            {"type": ["integer", "null"]},
            {"enum": "mild"},
            {"enum": [[], {}, None, float("nan"), 10**5000]},
            {"minimum": "1", "maximum": True},
            {"minimum": float("nan"), "maximum": float("inf")},
            {"default": [1], "unit": 5},
            {"default": 10**5000},
            {"x": deep(500)},
            {str(number): deep(2) for number in range(10_000)},
        )
        for required in (None, 5, "a", [["a"], "a", 5])
    ],
]


@pytest.mark.parametrize("functions", HOSTILE)
def test_hostile_description_is_read_as_plain_data_within_bounds(functions: Any) -> None:
    began = time.monotonic()
    for verb in verbs_of(functions):
        said = json.dumps([verb.schema(), verb.description, verb.name, verb.takes, verb.lasts_s], allow_nan=False)
        assert len(said) < 64_000
        assert not set("\x1b\x07\u202e\ud800") & set(verb.description + verb.name)
        assert 0.0 <= verb.lasts_s <= 3600.0
        assert all(
            typed(each, "x", "x") == "x" for each in verb.parameters if each.type == "string" and not each.choices
        )
    absent_safety(functions)
    assert time.monotonic() - began < 5.0


def test_ten_thousand_verbs_cost_bounded_work_and_each_is_found() -> None:
    functions = [{**BREW, "name": f"verb{number}"} for number in range(10_000)]
    assert len(verbs_of(functions)) == 1000
    assert find_verb(functions, "verb9999") is not None
    assert len(near("zzz", (each["name"] for each in functions))) < 1000


def test_schema_is_cut_at_its_depth() -> None:
    copied, depth = plain_data(deep(500)), 0
    while isinstance(copied, dict) and "properties" in copied:
        copied, depth = (copied["properties"] or {}).get("a"), depth + 2
    assert depth <= 8


def test_device_without_a_lock_is_said_to_have_none() -> None:
    assert absent_safety([{"name": "echo"}]) == "This device has no lock, no lease and no stop."
    assert absent_safety([{"name": "stop"}]) == "This device has no lock and no lease."
    assert absent_safety([RESUME, {"name": "acquireControl"}, {"name": "stop"}]) == ""
    assert all(verb.own for verb in verbs_of([{"name": "pick"}])), "each verb of such a device is its own"
    assert [verb.own for verb in verbs_of([RESUME, {"name": "pick"}])] == [False, False]


def test_names_of_presence_are_read_as_data() -> None:
    assert own_names(["brewCoffee", 5, "\x1b", None]) == ["brewCoffee"]
    assert own_names("brewCoffee") == own_names(None) == []
