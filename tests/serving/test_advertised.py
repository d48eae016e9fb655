"""Verbs as robots advertise them: what faces read of a description, however hostile it is."""

from __future__ import annotations

import json
import time
from dataclasses import replace
from typing import Annotated, Any, Literal

import pytest

from strands_robots import Domain
from strands_robots import verb as declared
from strands_robots.serving.advertised import (
    TEXT_MAX,
    TOTAL_MAX,
    VERBS_MAX,
    AdvertisedVerb,
    RobotDescription,
    find_verb,
    typed,
)
from strands_robots.serving.offered_verbs import own_verbs
from strands_robots.serving.verbs import described
from strands_robots.utils import ValidationError, near

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
RESUME = {"name": "resume", "parameters": {"properties": {"assertion": {"type": "object"}}}}


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


@pytest.mark.parametrize("kind", ["read", "stop"])
def test_read_and_stop_ignore_what_they_do_not_know(kind: Any) -> None:
    assert replace(brew(), kind=kind).unknown(["strenght", "lease_id"]) == ""


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
        ("cups", "five", "cups must be an integer from 1 to 8, not 'five'."),
        ("cups", "1.5", "cups must be an integer from 1 to 8, not 1.5."),
        ("cups", "true", "cups must be an integer from 1 to 8, not True."),
        ("cups", "9", "cups must be an integer from 1 to 8, not 9."),
        ("strength", "weak", "strength must be one of mild, strong, not 'weak'."),
    ],
)
def test_value_that_does_not_fit_is_refused_by_name(parameter: str, text: str, said: str) -> None:
    with pytest.raises(ValidationError) as refused:
        typed(brew().by_name[parameter], parsed(text), text)
    assert said in str(refused.value)


class Painter:
    @declared(motion=False)
    def paint(
        self,
        coats: Annotated[int, Domain(1)],
        width: Annotated[float, Domain(0.1, 2.5, "m")],
        depth: Annotated[float, Domain(high=3)],
        shade: float,
        layer: Literal[1, 2],
        colour: Literal["red", "blue"],
    ) -> None:
        """Paint."""


@pytest.mark.parametrize("value", ["x", 0, 9.5, -1e9, True, 1e400])
@pytest.mark.parametrize("name", ["coats", "width", "depth", "shade", "layer", "colour"])
def test_value_is_refused_in_the_words_of_the_robot(name: str, value: object) -> None:
    served = own_verbs(Painter())["paint"]
    parameter = RobotDescription.of([described(served)]).verbs["paint"].by_name[name]
    said = ""
    try:
        served.by_name[name].check(name, value)
    except ValidationError as exc:
        said = str(exc)
    assert parameter.problem(value) == said


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


def in_items(levels: int) -> dict[str, Any]:
    schema: dict[str, Any] = {}
    for _ in range(levels):
        schema = {"items": schema}
    return schema


def with_parameters(**properties: Any) -> dict[str, Any]:
    return {**BREW, "parameters": {"properties": properties}}


HOSTILE: list[Any] = [
    None,
    5,
    "functions",
    {"name": "x"},
    [{"name": each} for each in (3, "a b", "x" * 101, "\u202eevil", "na\u00efve")],
    [{"name": "a", "parameters": {"properties": {"x": None, "from": {}, "b c": {}, 7: {}}, "required": [[], {}]}}],
    [{"name": "a", "labels": {"direction": ["read"], "own": {}, "lasts_s": "nan"}}, {"name": "a"}],
    [with_parameters(**{f"p{number}": {} for number in range(5000)})],
    [with_parameters(x={str(key): [] for key in range(100_000)})],
    [with_parameters(x={"type": ["number"], "default": float("nan"), "minimum": 10**400, "enum": {"a": 1}, "unit": 3})],
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
    description = RobotDescription.of(functions)
    for verb in description.verbs.values():
        said = json.dumps([verb.schema(), verb.description, verb.name, verb.takes, verb.lasts_s], allow_nan=False)
        assert len(said) < 64_000
        assert not set("\x1b\x07\u202e\ud800") & set(verb.description + verb.name)
        assert 0.0 <= verb.lasts_s <= 3600.0
        assert all(
            typed(each, "x", "x") == "x" for each in verb.parameters if each.type == "string" and not each.choices
        )
    assert not set("\x1b\x07\u202e\ud800") & set("".join(description.left_out))
    assert time.monotonic() - began < 5.0


def test_more_verbs_than_the_bound_are_left_out_and_each_is_found() -> None:
    functions = [{"name": f"verb{number}"} for number in range(10_000)]
    read = RobotDescription.of(functions)
    assert len(read.verbs) == VERBS_MAX
    assert read.left_out == ("9500 verbs after the first 500",)
    assert find_verb(functions, "verb9999") is not None
    assert len(near("zzz", (each["name"] for each in functions))) < 1000


def test_all_verbs_together_take_no_more_than_the_bound_and_own_ones_come_first() -> None:
    many = [{"name": f"verb{number}", "description": "x" * 5000} for number in range(400)]
    read = RobotDescription.of([*many, BREW])
    taken = sum(len(verb.description) for verb in read.verbs.values())
    assert 0 < taken <= TOTAL_MAX
    assert all(len(verb.description) <= TEXT_MAX for verb in read.verbs.values())
    assert read.left_out[-1].endswith("more")
    assert list(read.verbs)[-1] == "brewCoffee", "own verbs are read first, and keep their place"


def test_bulky_robot_costs_bounded_time() -> None:
    bulky = with_parameters(
        **{f"p{number}": dict.fromkeys(map(str, range(10_000)), "\x00" * 5000) for number in range(90)}
    )
    began = time.monotonic()
    read = RobotDescription.of([{**bulky, "name": f"a{number}"} for number in range(10_000)])
    assert time.monotonic() - began < 5
    assert read.left_out


@pytest.mark.parametrize("schema", [in_items(9), in_items(500), in_items(100_000), deep(500)])
def test_deep_schema_is_left_out_and_its_verb_stays_and_may_be_given_it(schema: dict[str, Any]) -> None:
    read = RobotDescription.of([with_parameters(fast={"type": "number"}, deep=schema)])
    assert list(read.verbs["brewCoffee"].by_name) == ["fast"]
    assert "parameter deep of brewCoffee, nested deeper than 8" in read.left_out
    assert read.verbs["brewCoffee"].unknown(["deep"]) == ""


def test_choice_with_more_values_than_are_read_is_left_to_the_robot() -> None:
    verb = RobotDescription.of([with_parameters(cup={"enum": list(range(100))})]).verbs["brewCoffee"]
    assert verb.by_name["cup"].problem(99) == verb.by_name["cup"].problem(200) == ""


def test_second_verb_of_a_name_is_left_out() -> None:
    read = RobotDescription.of([{"name": "a", "description": "First."}, {"name": "a"}])
    assert (read.verbs["a"].description, read.left_out) == ("First.", ("a second verb a",))


def test_own_verbs_reads_and_stops_are_told_apart() -> None:
    labels = {"direction": "read", "own": "true", "lasts_s": "90"}
    read = RobotDescription.of([RESUME, {"name": "beansLeft", "labels": labels}, {"name": "stop", "labels": labels}])
    verb = read.verbs["beansLeft"]
    assert (verb.kind, verb.own, verb.lasts_s) == ("read", True, 90.0)
    assert (read.verbs["stop"].kind, read.verbs["resume"].kind) == ("stop", "motion")


@pytest.mark.parametrize(
    ("names", "lacking", "said"),
    [
        (["echo", "resume"], ("lockout", "lease", "stop"), "This device has no lockout, no lease and no stop."),
        (["stopMotion", "acquireControl"], ("lockout", "lease"), "This device has no lockout and no lease."),
        (["stop", "acquireControl", "renewControl", "releaseControl"], ("lockout",), "This device has no lockout."),
    ],
)
def test_device_without_a_lockout_is_said_to_have_none(names: list[str], lacking: tuple[str, ...], said: str) -> None:
    read = RobotDescription.of([{"name": name} for name in names])
    assert (read.lacking, read.absent) == (lacking, said)
    assert all(verb.own for verb in read.verbs.values()), "each verb of such a device is its own"


def test_robot_of_ours_lacks_nothing_however_many_verbs_it_has() -> None:
    safety = [{"name": name} for name in ("stop", "acquireControl", "renewControl", "releaseControl")]
    read = RobotDescription.of([*({"name": f"verb{number}"} for number in range(500)), RESUME, *safety])
    assert (read.lacking, read.absent) == ((), "")
    assert "resume" not in read.verbs
    assert not read.verbs["verb1"].own
