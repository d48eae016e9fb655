"""Every face on both networks: one robot of a stranger, and robots whose verbs misbehave."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest
from fixtures.face_robots import OURS, FaceSite
from fixtures.faces import Answer, Face, PageFace, described_by
from fixtures.waiting import eventually

from strands_robots import connect
from strands_robots.errors import ControlError

pytestmark = pytest.mark.timeout(300)
BARISTA, MILL, CARELESS = OURS


@pytest.fixture(autouse=True)
def free(site: FaceSite) -> Iterator[None]:
    """Robots that stand, and that no earlier test has locked."""
    yield
    site.robots.ask("stand", False)
    site.robots.ask("release")
    site.robots.ask("deadline", 20.0)
    site.robots.ask("clear")


@contextmanager
def called(
    face: Face, robot: str, verb: str, begun: Callable[[], object], **arguments: object
) -> Iterator[list[Answer]]:
    """Call a verb on a thread for the length of a block, which begins once the robot has begun.

    Yields:
        A list that has its answer after the block.
    """
    answers: list[Answer] = []
    calling = threading.Thread(target=lambda: answers.append(face.call(robot, verb, **arguments)))
    calling.start()
    try:
        eventually(lambda: begun() or answers, 60.0, what=f"{verb} of {robot} begins")
        assert not answers, answers
        yield answers
    finally:
        calling.join(90.0)
    assert not calling.is_alive(), f"{verb} of {robot} was never answered"


class TestFaceContract:
    """What a user of any face can do with a robot on any network."""

    @pytest.fixture
    def brewing(self, site: FaceSite) -> Callable[[], object]:
        """Return True while the barista brews, which then lasts until a stop."""
        site.robots.ask("stand", True)
        before = site.robots.ask("steps")
        return lambda: site.robots.ask("steps") > before

    def test_every_robot_is_found(self, face: Face) -> None:
        eventually(lambda: face.find() == {*OURS}, what="the robots, and no other")

    def test_verbs_are_described_and_reads_answered(self, site: FaceSite, face: Face) -> None:
        described = eventually(lambda: described_by(face, BARISTA, "Brew coffee, two seconds a cup."))
        assert {"brewCoffee", "beansLeft"} <= described.verbs
        assert face.domain in described.words
        read = face.call(BARISTA, "beansLeft")
        assert read.ok, read
        assert read.fields["result"] == site.robots.ask("beans")

    def test_own_verb_is_carried_out_with_its_arguments(self, face: Face) -> None:
        for cups in (1, 2):
            answer = face.call(BARISTA, "brewCoffee", cups=cups, strength="strong")
            assert answer.ok, answer
            assert (answer.fields["cups"], answer.fields["strength"]) == (cups, "strong")

    @pytest.mark.parametrize(
        ("arguments", "said"),
        [
            ({"cups": 9}, "cups must be"),
            ({}, "cups"),
            ({"cups": 1, "strength": "lethal"}, "strength"),
            ({"cups": 1, "mugs": 1}, "mugs"),
        ],
    )
    def test_argument_that_does_not_fit_is_refused_by_name(
        self, site: FaceSite, face: Face, arguments: dict[str, object], said: str
    ) -> None:
        before = site.robots.ask("steps")
        refused = face.call(BARISTA, "brewCoffee", **arguments)
        assert not refused.ok
        assert said in refused.text
        assert site.robots.ask("steps") == before

    def test_robot_that_another_caller_holds_is_not_moved(self, site: FaceSite, face: Face) -> None:
        with connect(name="holder") as fleet, fleet[BARISTA].control(ttl_s=60.0):
            before = site.robots.ask("steps")
            refused = face.call(BARISTA, "brewCoffee", cups=1)
            assert not refused.ok
            assert "holds control" in refused.text
            assert site.robots.ask("steps") == before
            assert face.call(BARISTA, "beansLeft").ok
            assert face.stop(BARISTA).ok, "a stop needs no lease"
        assert face.call(BARISTA, "brewCoffee", cups=1).ok

    def test_page_holds_a_robot_without_joints(self, site: FaceSite, face: Face) -> None:
        if not isinstance(face, PageFace):
            return
        with face.holding(BARISTA) as taken, connect(name="other") as fleet:
            assert taken.ok, taken
            assert face.call(BARISTA, "brewCoffee", cups=1).ok, "its call sends the lease"
            with pytest.raises(ControlError):
                fleet[BARISTA].call("brewCoffee", cups=1)
        assert face.call(BARISTA, "brewCoffee", cups=1).ok

    def test_stop_ends_a_verb_in_its_middle_and_the_next_one_begins(
        self, site: FaceSite, face: Face, brewing: Callable[[], object]
    ) -> None:
        for _ in range(2):
            with called(face, BARISTA, "brewCoffee", brewing, cups=8) as answers:
                second = face.call(BARISTA, "brewCoffee", cups=1)
                assert not second.ok, "one motor does not brew twice at a time"
                stopped = face.stop(BARISTA)
                assert stopped.ok, stopped
                steps = site.robots.ask("steps")
            assert not answers[0].ok, "what a stop ended is not done"
            assert "brewCoffee stopped: it was stopped." in answers[0].text, answers
            assert site.robots.ask("steps") == steps
            before = steps
            brewing = lambda before=before: site.robots.ask("steps") > before  # noqa: E731 - the next turn's
        site.robots.ask("stand", False)
        assert face.call(BARISTA, "brewCoffee", cups=1).ok

    def test_emergency_stop_locks_until_the_operators_key_resumes(
        self, site: FaceSite, face: Face, brewing: Callable[[], object]
    ) -> None:
        with called(face, BARISTA, "brewCoffee", brewing, cups=8):
            stopped = face.estop()
            assert stopped.ok, stopped
            steps = site.robots.ask("steps")
        site.robots.ask("stand", False)
        for _ in range(2):
            refused = face.call(BARISTA, "brewCoffee", cups=1)
            assert not refused.ok
            assert "is locked by the emergency stop of" in refused.text
            assert "To resume: " in refused.text
        assert face.call(BARISTA, "beansLeft").ok
        assert site.robots.ask("steps") == steps
        freed = face.resume(BARISTA)
        assert freed.ok is face.free_alone, freed
        if not freed.ok:
            assert not face.call(BARISTA, "brewCoffee", cups=1).ok
            return
        assert site.robots.ask("steps") == steps, "a resume starts nothing"
        assert face.call(BARISTA, "brewCoffee", cups=1).ok
        assert not face.call(MILL, "grind").ok, "the others stay locked"

    def test_verb_that_ignores_its_permit_is_named_and_keeps_the_robot_busy(self, site: FaceSite, face: Face) -> None:
        site.robots.ask("hang")
        site.robots.ask("deadline", 0.5)
        with called(face, MILL, "grind", lambda: site.robots.ask("grinding")):
            try:
                for _ in range(2):
                    moving = face.stop(MILL)
                    assert not moving.ok
                    assert "grind" in moving.text
                refused = face.call(MILL, "grind")
                assert not refused.ok
                assert "grind" in refused.text or "earlier calls" in refused.text
                assert face.call(BARISTA, "beansLeft").ok, "another robot answers"
            finally:
                site.robots.ask("release")
        eventually(lambda: face.stop(MILL).ok, what="the mill stands")
        assert face.call(MILL, "grind").ok

    def test_verb_that_raises_is_a_fault_of_the_robot_and_numpy_an_answer(self, face: Face) -> None:
        for _ in range(2):
            failed = face.call(CARELESS, "spill")
            assert not failed.ok
            assert "failed inside" in failed.text
            weighed = face.call(CARELESS, "weigh")
            assert weighed.ok, weighed
            assert (weighed.fields["grams"], weighed.fields["samples"]) == (12.5, [[1.0, 2.0]])
            assert weighed.fields["count"] == 3
            unfit = face.call(CARELESS, "noise")
            assert not unfit.ok
            assert "It returned what JSON cannot carry: grams[1] is nan." in unfit.text
        moved = face.call(CARELESS, "peek")
        assert not moved.ok
        assert "declared a read" in moved.text
