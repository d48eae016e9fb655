"""The rail keeps its promises, up to gold: it brakes, which takes longer than platinum allows."""

from tarn_rail.conformance import subject

from strands_robots.testing import Tier, conformance_tests

TestPromises = conformance_tests(subject, Tier.GOLD, proven=Tier.GOLD)
