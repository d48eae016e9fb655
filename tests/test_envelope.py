"""The one shape of an answer."""

from __future__ import annotations

from strands_robots import envelope


def test_a_success_holds_its_fields_flat_and_as_json() -> None:
    answer = envelope.success("Done.", steps=3)
    assert answer == {"status": "success", "content": [{"text": "Done."}, {"json": {"steps": 3}}], "steps": 3}
    assert not envelope.is_error(answer)


def test_an_error_says_why_in_its_reason_and_in_its_text() -> None:
    answer = envelope.error("No.", stopped=False)
    assert answer["reason"] == envelope.text_of(answer) == "No."
    assert answer["stopped"] is False
    assert answer["content"][1] == {"json": {"stopped": False}}
    assert envelope.is_error(answer)


def test_an_answer_without_fields_has_text_alone() -> None:
    assert envelope.success("Done.")["content"] == [{"text": "Done."}]


def test_what_is_no_envelope_is_no_error_and_has_no_text() -> None:
    assert not envelope.is_error(None)
    assert envelope.text_of({}) == ""
    assert envelope.text_of({"reason": "why"}) == "why"
    assert envelope.text_of({"content": ["?", {"text": 5}, {"text": "yes"}]}) == "yes"
