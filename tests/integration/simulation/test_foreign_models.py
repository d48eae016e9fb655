"""Every model of eight other projects does in a world of ours what docs/foreign-models.md says (`make models`)."""

from __future__ import annotations

import pytest
from fixtures.foreign_models import PACKAGES, first_word, installed, models, outcomes_on_the_page, trial

pytestmark = [
    pytest.mark.skipif(not installed(), reason="needs the models of other projects: make models"),
    pytest.mark.timeout(900),
    pytest.mark.filterwarnings("ignore::UserWarning"),
]


@pytest.mark.parametrize("package", PACKAGES)
def test_model_does_what_the_page_says(package: str) -> None:
    rows = [trial(package, path) for owner, path in models() if owner == package]
    assert {row.file: first_word(row.outcome) for row in rows} == outcomes_on_the_page(package)
