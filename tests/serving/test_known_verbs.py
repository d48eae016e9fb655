from __future__ import annotations

from strands_robots.kinematics import ArmParts
from strands_robots.serving import advertised
from strands_robots.serving.arm_verbs import ARM_MOTION_VERBS
from strands_robots.serving.peer_verbs import PEER_VERBS
from strands_robots.serving.reachy_verbs import REACHY_VERBS
from strands_robots.serving.robot_verbs import NAVIGATING_BASE_VERBS, TASK_VERBS, WORLD_VERBS
from strands_robots.serving.verbs import Kind

# Of two entries of a name, that of Device Connect comes last: there a verb may be answered sooner.
TABLES = (PEER_VERBS, REACHY_VERBS, NAVIGATING_BASE_VERBS, WORLD_VERBS, TASK_VERBS)
VERBS = {name: verb for table in TABLES for name, verb in table.items()}


def named(*kinds: Kind, lasts: bool = False) -> set[str]:
    return {verb.name for verb in VERBS.values() if verb.kind in kinds and verb.lasts is lasts}


def test_names_are_those_of_the_tables() -> None:
    assert named(Kind.READ) == advertised.READS
    assert named(Kind.STOP) == advertised.STOPS
    assert named(Kind.RESUME) == advertised.RESUMES
    assert named(Kind.READ, Kind.MOTION, lasts=True) == advertised.WAITING
    assert named(Kind.MOTION) == advertised.STARTING
    assert VERBS.keys() == advertised.VERBS


def test_texts_are_those_of_the_tables() -> None:
    parameters = [each for table in TABLES for verb in table.values() for each in verb.parameters]
    texts = {each.name for each in parameters if each.type is str}
    assert texts == advertised.TEXTS
    assert not texts & {each.name for each in parameters if each.type is not str}


def test_an_arm_with_all_parts_advertises_each_verb_of_arms() -> None:
    whole = ArmParts(joints=True, model=True, tip=True, jaws=True)
    assert whole.verbs(sees=True) == ARM_MOTION_VERBS.keys()
