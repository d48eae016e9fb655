"""The rail keeps its promises."""

from tarn_rail.conformance import subject

from strands_robots.testing import Tier, conform


def test_it_keeps_its_promises() -> None:
    report = conform(subject())
    assert report.tier is not None, report.words()
    assert report.tier.value >= Tier.GOLD.value, report.words()
