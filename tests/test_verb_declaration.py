"""What a robot's author declares: names, hints, docstrings, and calls of the method itself."""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable
from typing import Annotated, Any, Literal, Optional

import pytest
from fixtures.barista import Barista, Careless, Stubborn
from fixtures.waiting import eventually

from strands_robots import Domain, Permit, verb
from strands_robots.adapted import adapt
from strands_robots.safety.gate import MotionRefused, gate_of
from strands_robots.utils import ValidationError
from strands_robots.verb_declaration import declared_verbs


def declared(method: Callable[..., Any], **options: Any) -> Any:
    """Return the declaration of a method of a robot that has no other."""
    kind = type("Robot", (), {"method": verb(**options)(method) if options else verb(method)})
    return next(iter(declared_verbs(kind()).values()))


def test_hints_and_docstring_are_the_description() -> None:
    brew = declared_verbs(Barista())["brewCoffee"]
    assert (brew.summary, brew.returns, brew.motion, brew.lasts) == ("Brew coffee.", "cups and strength", True, 60.0)
    assert {each.name: each.schema for each in brew.parameters} == {
        "cups": {"type": "integer", "minimum": 1, "maximum": 8, "description": "how many cups"},
        "strength": {
            "type": "string",
            "enum": ["mild", "strong"],
            "default": "mild",
            "description": "of the coffee",
        },
    }
    assert brew.permit == "permit"


HINTS: list[tuple[Any, object, object, dict[str, Any]]] = [
    (bool, True, 1, {"type": "boolean"}),
    (int, 3, True, {"type": "integer"}),
    (float, 2, float("nan"), {"type": "number"}),
    (str, "", 5, {"type": "string", "maxLength": 2000}),
    (
        Annotated[float, Domain(0.0, 1.5, "m")],
        1.5,
        1.6,
        {"type": "number", "minimum": 0.0, "maximum": 1.5, "unit": "m"},
    ),
    (Annotated[int, Domain(low=1)], 1, 0, {"type": "integer", "minimum": 1}),
    (Literal[1, 2], 2, 3, {"type": "integer", "enum": [1, 2]}),
    (Literal[1, 2], 1, True, {"type": "integer", "enum": [1, 2]}),
    (Optional[int], None, "x", {"type": "integer"}),  # noqa: UP045 - authors write this, too
    (int | None, 4, 4.5, {"type": "integer"}),
    (
        list[Annotated[float, Domain(0, 1)]],
        [0, 0.5],
        [2],
        {"type": "array", "maxItems": 1000, "items": {"type": "number", "minimum": 0, "maximum": 1}},
    ),
    (dict[str, int], {"a": 1}, {"a": "b"}, {"type": "object", "additionalProperties": {"type": "integer"}}),
    (list, [1, "a"], [float("inf")], {"type": "array", "maxItems": 1000}),
    (dict, {"a": None}, [1], {"type": "object"}),
]


@pytest.mark.parametrize(("hint", "good", "bad", "schema"), HINTS, ids=lambda value: str(value)[:40])
def test_argument_is_checked_by_its_hint(hint: Any, good: object, bad: object, schema: dict[str, Any]) -> None:
    def method(self: object, given: Any) -> None: ...

    method.__annotations__["given"] = hint
    (parameter,) = declared(method).parameters
    assert parameter.schema == schema
    assert parameter.check("given", good) == good
    with pytest.raises(ValidationError, match=r"^given"):
        parameter.check("given", bad)


def with_no_hint(self: object, cups) -> None: ...  # type: ignore[no-untyped-def]


def with_object(self: object, cups: object) -> None: ...


def with_bytes(self: object, cups: bytes) -> None: ...


def with_several(self: object, *cups: int) -> None: ...


def with_mixed(self: object, cups: Literal[1, "a"]) -> None: ...


def with_keys(self: object, cups: dict[int, int]) -> None: ...


def with_text_domain(self: object, cups: Annotated[str, Domain(1, 2)]) -> None: ...


def with_two_permits(self: object, permit: Permit, other: Permit) -> None: ...


def with_bad_default(self: object, cups: Annotated[int, Domain(1, 8)] = 9) -> None: ...


def with_hidden(self: object, _cups: int) -> None: ...


@pytest.mark.parametrize(
    ("method", "problem"),
    [
        (with_no_hint, "needs a type hint"),
        (with_object, "must be bool, int, float"),
        (with_bytes, "must be bool, int, float"),
        (with_several, "no name that a caller could give"),
        (with_mixed, "Literal of texts, of numbers or of booleans alone"),
        (with_keys, "texts as keys"),
        (with_text_domain, "of numbers only"),
        (with_two_permits, "takes one Permit"),
        (with_bad_default, "default of .* is outside its domain"),
        (with_hidden, "begins with an underscore"),
    ],
)
def test_verb_that_no_message_can_carry_is_refused_by_its_name(method: Callable[..., Any], problem: str) -> None:
    with pytest.raises(ValidationError, match=problem) as refused:
        declared(method).check()
    assert method.__name__ in str(refused.value)


def test_read_that_asks_for_a_permit_is_refused() -> None:
    def look(self: object, permit: Permit) -> None: ...

    look.__annotations__["permit"] = Permit
    with pytest.raises(ValidationError, match="moves nothing"):
        declared(look, motion=False).check()


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        ({"motion": 1}, "motion must be true or false"),
        ({"lasts": -1.0}, "lasts must be"),
        ({"lasts": 3601}, "lasts must be"),
        ({"lasts": float("nan")}, "lasts must be"),
        ({"name": "Brew"}, "camelCase"),
        ({"name": "brew coffee"}, "camelCase"),
        ({"name": "b" * 65}, "name must be text of 1 to 64"),
    ],
)
def test_option_outside_its_domain_is_refused_by_name(options: dict[str, Any], problem: str) -> None:
    def brew(self: object) -> None: ...

    with pytest.raises(ValidationError, match=problem):
        verb(**options)(brew)


def test_coroutine_and_generator_are_refused() -> None:
    async def later(self: object) -> None: ...

    with pytest.raises(ValidationError, match="plain method"):
        verb(later)


def test_two_verbs_of_one_name_are_refused() -> None:
    class Twice:
        @verb
        def brew_coffee(self, permit: Permit) -> None: ...

        @verb
        def brewCoffee(self, permit: Permit) -> None: ...

    with pytest.raises(ValidationError, match=r"two verbs brewCoffee: brewCoffee and brew_coffee|brew_coffee and"):
        declared_verbs(Twice())


def test_override_without_the_decorator_is_refused() -> None:
    class Plain(Barista):
        def brew_coffee(self, cups: int) -> dict[str, Any]:  # type: ignore[override]
            return {}

    with pytest.raises(ValidationError, match="overrides a verb; declare it"):
        declared_verbs(Plain())


def test_method_itself_is_called_like_any_other_and_gets_its_permit() -> None:
    robot = Barista()
    assert robot.brew_coffee(2) == {"cups": 2, "strength": "mild"}
    assert robot.brew_coffee(cups=1, strength="strong") == {"cups": 1, "strength": "strong"}
    assert robot.beans_left() == 250.0
    for bad, problem in (({"cups": 9}, "cups"), ({"cups": True}, "cups"), ({}, "needs cups"), ({"mugs": 1}, "mugs")):
        with pytest.raises(ValidationError, match=problem):
            robot.brew_coffee(**bad)
    with pytest.raises(ValidationError, match="at most 2 arguments"):
        robot.brew_coffee(1, "mild", 3)
    assert robot.cups == 3


def test_halt_of_the_adapted_robot_ends_its_verb_and_says_so() -> None:
    robot = Barista()
    seen = adapt(robot)
    working = threading.Thread(target=robot.brew_coffee, args=(8,))
    working.start()
    eventually(robot.brewing.is_set)
    assert seen.get_task_status()["verb"] == "brewCoffee"
    verdict = seen.halt("enough")
    assert (verdict.stopped, verdict.halted) == (True, ("brewCoffee",))
    written = robot.writes
    working.join(20.0)
    assert robot.writes == written
    assert seen.get_task_status()["task_status"] == "idle"
    assert adapt(robot).gate is seen.gate is gate_of(robot)


def test_verb_that_ignores_its_permit_did_not_stop_and_keeps_the_robot_busy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STRANDS_HALT_DEADLINE_S", "0.3")
    robot = Stubborn()
    seen = adapt(robot)
    working = threading.Thread(target=robot.grind)
    working.start()
    try:
        eventually(robot.started.is_set)
        for _ in range(2):
            verdict = seen.halt()
            assert verdict.stopped is False
            assert "has not returned" in verdict.not_stopped["grind"]
        with pytest.raises(MotionRefused, match="grind of this robot has not returned"):
            robot.grind()
    finally:
        robot.released.set()
        working.join(20.0)
    assert seen.halt().stopped is True


def test_read_moves_nothing() -> None:
    with pytest.raises(MotionRefused, match="peek is declared a read"):
        Careless().peek()


def test_verb_may_call_another_of_its_robot_and_no_other_caller_may_meanwhile() -> None:
    class Waiter(Barista):
        @verb
        def serve_guests(self, permit: Permit) -> dict[str, Any]:
            refused: list[str] = []

            def other() -> None:
                try:
                    self.brew_coffee(1)
                except MotionRefused as exc:
                    refused.append(str(exc))

            rival = threading.Thread(target=other)
            rival.start()
            rival.join(20.0)
            return {**self.brew_coffee(1, permit), "rival": refused}

    served = Waiter().serve_guests()
    assert served["cups"] == 1
    assert "serveGuests of this robot has not returned" in served["rival"][0]


def test_robots_that_are_equal_or_have_no_hash_have_gates_of_their_own() -> None:
    class Same(Barista):
        __hash__ = None  # type: ignore[assignment]

        def __eq__(self, other: object) -> bool:
            return True

    one, other = Same(), Same()
    assert gate_of(one) is not gate_of(other)
    assert gate_of(one) is gate_of(one)


def test_decorator_above_is_refused_because_a_network_would_leave_it_out() -> None:
    def guarded(method: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(method)
        def guard(*values: Any, **named: Any) -> Any:
            raise RuntimeError("not today")

        return guard

    class Guarded:
        @guarded
        @verb
        def brew(self, permit: Permit) -> None: ...

    with pytest.raises(ValidationError, match="decorator above @verb"):
        declared_verbs(Guarded())

    class Inside:
        @verb(motion=False)
        @guarded
        def look(self) -> None: ...

    with pytest.raises(RuntimeError, match="not today"):
        Inside().look()


def test_attribute_of_the_class_that_answers_to_every_name_is_no_verb() -> None:
    class Proxy:
        def __getattr__(self, name: str) -> object:
            raise AssertionError(f"{name} was asked of another machine")

    class Robot(Barista):
        server = Proxy()

    assert set(declared_verbs(Robot())) == {"brewCoffee", "beansLeft"}


def test_permit_is_void_once_its_verb_has_returned_or_its_time_is_over() -> None:
    class Keeps:
        permit: Permit | None = None

        @verb
        def keep(self, permit: Permit) -> bool:
            self.permit = permit
            return permit.valid

    robot = Keeps()
    assert robot.keep() is True
    assert robot.permit is not None
    assert not robot.permit.valid
    with gate_of(robot).moving("keep", 0.05) as permit:
        eventually(lambda: not permit.valid)


def test_verb_that_halts_its_own_robot_does_not_wait_for_itself() -> None:
    class Careful(Barista):
        @verb
        def feel(self, permit: Permit) -> dict[str, Any]:
            verdict = adapt(self).halt("I felt something")
            return {"stopped": verdict.stopped, "valid": permit.valid}

    assert Careful().feel() == {"stopped": True, "valid": False}


def test_default_that_no_message_can_carry_is_refused() -> None:
    def with_sets(self: object, cups: list = [{1}]) -> None: ...  # type: ignore[type-arg]  # noqa: B006 - the point

    with pytest.raises(ValidationError, match="with_sets"):
        declared(with_sets).check()
