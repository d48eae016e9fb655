"""RemoteRobot: verbs as methods, refusals, halt, lease, what is reachable by call alone."""

from __future__ import annotations

import base64
import copy
import inspect
import io
import pydoc
import threading
from typing import Any

import numpy as np
import pytest
from fixtures.waiting import eventually
from PIL import Image
from tests.fleet.scripted import LEASE, OURS, ScriptedNetwork, function

from strands_robots import errors
from strands_robots.envelope import error, success
from strands_robots.errors import RefusalError
from strands_robots.fleet import reports
from strands_robots.fleet.adapter import FoundRobot, RobotEvent
from strands_robots.fleet.remote_robot import RemoteRobot, python_name
from strands_robots.serving.offered_verbs import MEMBERS, STOPS
from strands_robots.utils import WAIT_S, ValidationError


@pytest.fixture
def network() -> ScriptedNetwork:
    return ScriptedNetwork()


@pytest.fixture
def arm(network: ScriptedNetwork) -> RemoteRobot:
    return RemoteRobot(FoundRobot("arm-1", "strands_robot", "so100"), network)


def robot_with(*functions: Any) -> tuple[RemoteRobot, ScriptedNetwork]:
    network = ScriptedNetwork(robots={"r": functions})
    return RemoteRobot(FoundRobot("r"), network), network


class TestVerbsAsMethods:
    def test_verb_is_called_by_its_name_in_snake_case(self, arm: RemoteRobot, network: ScriptedNetwork) -> None:
        assert arm.move_to(x=0.25)["verb"] == "moveTo"
        assert arm.move_to(0.25, speed=0.1)["status"] == "success"
        assert [call[1:3] for call in network.calls] == [
            ("moveTo", {"x": 0.25}),
            ("moveTo", {"x": 0.25, "speed": 0.1}),
        ]

    def test_signature_and_docstring_describe_it_without_the_lease(self, arm: RemoteRobot) -> None:
        assert str(inspect.signature(arm.move_to)) == "(x: float, speed: float = 0.5) -> dict"
        assert arm.move_to.__name__ == "move_to"
        said = pydoc.plain(pydoc.render_doc(arm.move_to))
        assert "Do moveTo." in said
        assert "x: in m" in said
        assert said.strip().endswith("(as the robot describes it)")

    def test_dir_lists_verbs_and_own_members(self, arm: RemoteRobot) -> None:
        assert {"move_to", "get_status", "halt", "call"} <= set(dir(arm))

    def test_too_many_values_and_a_value_given_twice_are_type_errors(self, arm: RemoteRobot) -> None:
        with pytest.raises(TypeError, match="positional"):
            arm.move_to(1, 2, 3)
        with pytest.raises(TypeError, match="multiple values for argument x"):
            arm.move_to(1, x=2)

    def test_unknown_verb_names_similar_ones(self, arm: RemoteRobot) -> None:
        assert not hasattr(arm, "fly")
        with pytest.raises(AttributeError, match=r"no verb move_too\. Near it: .*move_to"):
            arm.move_too()
        with pytest.raises(errors.UnknownVerbError, match="moveTo"):
            arm.call("moveTwo")
        with pytest.raises(errors.UnknownVerbError, match=r"Near it: stop\.$"):
            arm.call("stopp")

    def test_names_of_members_are_reachable_by_call_alone(self) -> None:
        names = ("halt", "call", "id", "__class__", "_private", "control", "brew")
        robot, network = robot_with(*(function(name) for name in names))
        assert robot.brew()["verb"] == "brew"
        assert (robot.id, robot.__class__) == ("r", RemoteRobot)
        assert robot.halt().stopped
        assert network.calls == [("r", "brew", {}, 10.0)]
        for name in names:
            assert robot.call(name)["verb"] == name
        assert not hasattr(robot, "_private")

    def test_two_verbs_of_one_name_are_reachable_by_call_alone(self) -> None:
        robot, _ = robot_with(function("brew_coffee"), function("brewCoffee"))
        with pytest.raises(AttributeError, match=r"Reach it by call\(\): brew_coffee, brewCoffee"):
            robot.brew_coffee()
        assert robot.call("brewCoffee")["verb"] == "brewCoffee"

    def test_robot_that_comes_back_with_other_verbs_is_described_anew(self) -> None:
        robot, network = robot_with(function("brew"))
        assert robot.brew()
        network.robots["r"] = (function("jump"), function("fly"))
        assert robot.jump()["verb"] == "jump"
        assert not hasattr(robot, "brew")
        network.robots["r"] = (function("swim"),)
        with pytest.raises(errors.UnknownVerbError, match="swim"):
            robot.fly()
        assert list(robot.verbs) == ["swim"]

    def test_verb_of_a_robot_that_is_gone_is_not_called_unknown(
        self, arm: RemoteRobot, network: ScriptedNetwork
    ) -> None:
        del network.robots["arm-1"]
        with pytest.raises(errors.NoSuchRobotError, match="gone"):
            arm.move_to(x=1)

    def test_verbs_that_were_found_are_known_of_a_robot_that_is_gone(self, network: ScriptedNetwork) -> None:
        arm = RemoteRobot(FoundRobot("arm-1", functions=OURS), network)
        del network.robots["arm-1"]
        assert list(arm.verbs) == [each["name"] for each in OURS]

    def test_copy_asks_the_robot_for_nothing(self, arm: RemoteRobot, network: ScriptedNetwork) -> None:
        assert copy.copy(arm).id == "arm-1"
        assert not network.calls

    @pytest.mark.parametrize(
        ("verb", "arguments", "seconds"),
        [
            (function("getIt", "read"), {}, 10.0),
            (function("go", wait={"type": "boolean"}), {}, 10.0 + WAIT_S),
            ({**function("brew"), "labels": {"lasts_s": "90"}}, {}, 100.0),
            ({**function("run", duration={}), "labels": {"lasts_s": "30"}}, {"duration": 300}, 310.0),
        ],
    )
    def test_call_waits_as_long_as_the_verb_may_take(self, verb: Any, arguments: Any, seconds: float) -> None:
        robot, network = robot_with(verb)
        robot.call(verb["name"], **arguments)
        robot.call(verb["name"], timeout=0.5, **arguments)
        assert [call[3] for call in network.calls] == [seconds, 0.5]


class TestRefusals:
    @pytest.mark.parametrize(
        ("answer", "cause"),
        [
            (error("x must be 1", refused="arguments"), errors.ArgumentsError),
            (error("no", refused="caller"), errors.CallerError),
            (error("no", refused="lockout", locked=True), errors.LockoutError),
            (error("no", refused="approval"), errors.ApprovalError),
            (error("no", refused="busy"), errors.BusyError),
            (error("no", refused="failed"), errors.RobotError),
            (error("no", code="not_holder", holder="ana"), errors.ControlError),
            (error("no", locked=True), errors.LockoutError),
            (error("moveTo takes x: it has no y."), errors.ArgumentsError),
            (error("moveTo moves real hardware and needs operator approval"), errors.ApprovalError),
            (error("no cube in sight"), errors.RobotError),
            ({"status": "error", "refused": ["arguments"], "content": 3, "reason": 7}, errors.RobotError),
        ],
    )
    def test_error_answer_raises_by_its_cause(
        self, arm: RemoteRobot, network: ScriptedNetwork, answer: Any, cause: type[RefusalError]
    ) -> None:
        network.answers["moveTo"] = lambda arguments: answer
        for call in (lambda: arm.move_to(x=1), lambda: arm.call("moveTo", x=1)):
            with pytest.raises(RefusalError) as refused:
                call()
            assert type(refused.value) is cause
            assert (refused.value.robot, refused.value.verb) == ("arm-1", "moveTo")
            assert refused.value.envelope == answer
            assert refused.value.why in str(refused.value)

    def test_reason_is_plain_text(self, arm: RemoteRobot, network: ScriptedNetwork) -> None:
        network.answers["moveTo"] = lambda arguments: error("\x1b]0;owned\x07\x1b[31mred\x1b[0m\r\nline" + "x" * 9000)
        with pytest.raises(errors.RobotError) as refused:
            arm.move_to(x=1)
        assert refused.value.why.startswith("red line")
        assert len(str(refused.value)) < 600


class TestHalt:
    def test_verdict_has_what_was_halted(self, arm: RemoteRobot, network: ScriptedNetwork) -> None:
        verdict = arm.halt("enough")
        assert verdict.stopped is True
        assert verdict.halted == ("task",)

    @pytest.mark.parametrize(
        ("answer", "stopped"),
        [
            (error("no brakes", stopped=False), False),
            (error("no answer", stopped=None), None),
            (OSError("gone"), None),
            (RuntimeError("bug"), None),
            (None, None),
            ({"status": 7, "stopped": ["\x1b[31m"] * 10_000}, None),
        ],
    )
    def test_halt_never_raises_and_names_the_robot(
        self, arm: RemoteRobot, network: ScriptedNetwork, answer: Any, stopped: bool | None
    ) -> None:
        network.stops = answer
        verdict = arm.halt()
        assert verdict.stopped is stopped
        assert "arm-1" in {**verdict.not_stopped, **verdict.unknown}

    def test_halt_asks_for_no_description(self) -> None:
        robot, network = robot_with()
        network.describe = lambda *_, **__: pytest.fail("described")  # type: ignore[method-assign]
        assert robot.halt().stopped


class TestControl:
    @pytest.fixture(autouse=True)
    def leases(self, network: ScriptedNetwork) -> None:
        network.answers["acquireControl"] = lambda arguments: success("held", lease_id="secret")

    def test_motions_inside_carry_the_lease(self, arm: RemoteRobot, network: ScriptedNetwork) -> None:
        with arm.control(ttl_s=30):
            arm.move_to(x=1)
            arm.status()
        arm.move_to(x=2)
        said = {verb: arguments for _, verb, arguments, _ in network.calls[:-1]}
        assert said["acquireControl"] == {"ttl_s": 30.0}
        assert said["moveTo"] == {"x": 1, "lease_id": "secret"}
        assert said["getStatus"] == {}
        assert said["releaseControl"] == {"lease_id": "secret"}
        assert network.calls[-1][2] == {"x": 2}

    def test_lease_is_released_after_an_exception(self, arm: RemoteRobot, network: ScriptedNetwork) -> None:
        with pytest.raises(ZeroDivisionError), arm.control():
            raise ZeroDivisionError
        assert network.calls[-1][1] == "releaseControl"
        assert not [thread for thread in threading.enumerate() if thread.name.startswith("fleet-lease")]

    def test_failed_release_does_not_hide_the_exception_of_the_block(
        self, arm: RemoteRobot, network: ScriptedNetwork
    ) -> None:
        network.answers["releaseControl"] = errors.NoAnswerError("silent")
        with pytest.raises(ZeroDivisionError), arm.control():
            raise ZeroDivisionError

    def test_lease_is_renewed_meanwhile(self, arm: RemoteRobot, network: ScriptedNetwork) -> None:
        def renewed() -> int:
            return [call[1] for call in network.calls].count("renewControl")

        with arm.control(ttl_s=0.06):
            eventually(lambda: renewed() >= 3, what="three renewals")

    def test_nested_and_overlapping_blocks_share_the_lease(self, arm: RemoteRobot, network: ScriptedNetwork) -> None:
        first, second = arm.control(), arm.control()
        with first, arm.control():
            second.__enter__()
        arm.move_to(x=1)
        second.__exit__(None, None, None)
        arm.move_to(x=2)
        said = [(verb, arguments.get("lease_id")) for _, verb, arguments, _ in network.calls]
        assert said == [
            ("acquireControl", None),
            ("moveTo", "secret"),
            ("releaseControl", "secret"),
            ("moveTo", None),
        ]
        with arm.control():
            arm.move_to(x=3)
        assert network.calls[-2][2] == {"x": 3, "lease_id": "secret"}

    def test_verb_without_a_description_carries_the_lease(self, arm: RemoteRobot, network: ScriptedNetwork) -> None:
        network.answers["newVerb"] = network.answers["status"] = lambda arguments: success("done")
        with arm.control():
            arm.call("newVerb", x=1)
            arm.call("status")
        said = {verb: arguments for _, verb, arguments, _ in network.calls}
        assert (said["newVerb"], said["status"]) == ({"x": 1, "lease_id": "secret"}, {})

    def test_robot_without_leases_refuses(self) -> None:
        robot, _ = robot_with(function("go"))
        with pytest.raises(errors.UnknownVerbError, match="no control lease"), robot.control():
            pytest.fail("controlled")


class TestRobotsOfAWorld:
    @pytest.fixture
    def world(self) -> tuple[RemoteRobot, ScriptedNetwork]:
        name = {"robot_name": {"type": "string"}}
        functions = (
            function("getStatus", "read"),
            function("start", **name, **LEASE),
            function("acquireControl", ttl_s={}, **name, **LEASE),
            function("renewControl", lease_id={"type": "string"}),
            function("releaseControl", lease_id={"type": "string"}),
        )
        robot, network = robot_with(*functions)
        network.answers["getStatus"] = lambda arguments: success("idle", robots=["left", "right"])
        network.answers["acquireControl"] = lambda arguments: success("held", lease_id="secret")
        return robot, network

    def test_robot_is_the_same_object_so_that_its_lease_counts(
        self, world: tuple[RemoteRobot, ScriptedNetwork]
    ) -> None:
        robot, network = world
        with robot.robots["left"].control():
            robot.robots["left"].start()
            robot.robots["right"].start()
        said = [arguments for _, verb, arguments, _ in network.calls if verb == "start"]
        assert said == [{"lease_id": "secret", "robot_name": "left"}, {"robot_name": "right"}]

    def test_robot_outlives_a_new_description_of_its_world(self, world: tuple[RemoteRobot, ScriptedNetwork]) -> None:
        robot, network = world
        left = robot.robots["left"]
        assert left.start()
        network.robots["r"] = (function("jump", robot_name={"type": "string"}),)
        robot.rediscovered(FoundRobot("r"), network)
        assert left.jump()
        with pytest.raises(errors.UnknownVerbError):
            left.call("start")
        assert network.calls[-1][2] == {"robot_name": "left"}


class TestWhatItIs:
    def test_robot_of_ours_has_stop_lockout_and_lease(self, arm: RemoteRobot) -> None:
        assert (arm.has_stop, arm.has_lockout, arm.has_lease) == (True, True, True)
        assert repr(arm) == "<RemoteRobot arm-1 (so100, device_connect)>"

    def test_bare_device_says_that_it_has_none(self) -> None:
        robot, _ = robot_with(function("brew"), function("resume"))
        assert (robot.has_stop, robot.has_lockout, robot.has_lease) == (False, False, False)
        assert "no lockout, no lease, no stop" in repr(robot)
        assert "no lockout, no lease, no stop" in str(robot.brew.__doc__)

    def test_kinds_of_verbs(self, arm: RemoteRobot) -> None:
        kinds = {name: arm.verbs[name].kind for name in ("moveTo", "getStatus", "stop")}
        assert kinds == {"moveTo": "motion", "getStatus": "read", "stop": "stop"}
        assert list(arm.verbs["moveTo"].by_name) == ["x", "speed"]
        assert len(arm.verbs) == len(OURS)
        assert LEASE.keys().isdisjoint(arm.verbs["acquireControl"].by_name)


class TestEventsAndPictures:
    def test_events_come_from_the_call_on_and_end_with_the_block(
        self, arm: RemoteRobot, network: ScriptedNetwork
    ) -> None:
        with arm.events(timeout=0.05) as events:
            for step in range(3):
                network.subscribers[0](RobotEvent("arm-1", "streamStep", {"step": step}))
            assert [event.payload["step"] for event in events] == [0, 1, 2]
        assert not network.subscribers

    def test_waiting_events_are_bounded_in_number_and_bytes(
        self, arm: RemoteRobot, network: ScriptedNetwork, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(reports, "EVENTS_MAX", 3)
        monkeypatch.setattr(reports, "BYTES_MAX", 10_000)
        with arm.events(timeout=0.05) as events:
            for step in range(5):
                network.subscribers[0](RobotEvent("arm-1", "streamStep", {"step": step}))
            assert [event.payload["step"] for event in events] == [2, 3, 4]
        with arm.events(timeout=0.05) as events:
            for step in range(3):
                network.subscribers[0](RobotEvent("arm-1", "streamStep", {"step": step, "rows": [{}] * 50}))
            assert [event.payload["step"] for event in events] == [1, 2]

    @pytest.mark.parametrize("timeout", [0, -1, float("nan"), 1e9, "x", True])
    def test_timeout_outside_its_domain_is_refused(self, arm: RemoteRobot, timeout: Any) -> None:
        with pytest.raises(ValidationError, match="timeout"):
            arm.call("getStatus", timeout=timeout)

    def test_picture_that_asks_for_gigabytes_is_refused(self, arm: RemoteRobot, network: ScriptedNetwork) -> None:
        jpeg = io.BytesIO()
        Image.new("RGB", (8, 8)).save(jpeg, "JPEG")
        # The frame header has the height and the width behind the precision.
        head, marker, rest = jpeg.getvalue().partition(b"\xff\xc0\x00\x11\x08")
        huge = base64.b64encode(head + marker + b"\xff\xff\xff\xff" + rest[4:]).decode()
        network.answers["getPicture"] = lambda arguments: success("", jpeg=huge)
        with pytest.raises(errors.RobotError, match="no picture"):
            arm.picture()

    def test_picture_is_an_array(self, arm: RemoteRobot, network: ScriptedNetwork) -> None:
        jpeg = io.BytesIO()
        Image.new("RGB", (32, 16), (200, 10, 10)).save(jpeg, "JPEG")
        network.answers["getPicture"] = lambda arguments: success("", jpeg=base64.b64encode(jpeg.getvalue()).decode())
        pixels = arm.picture("front", width=32)
        assert (pixels.shape, pixels.dtype) == ((16, 32, 3), np.uint8)
        assert network.calls[-1][2] == {"camera": "front", "width": 32, "height": 480}

    @pytest.mark.parametrize("jpeg", [None, 7, "%%%", base64.b64encode(b"GIF89a").decode()])
    def test_answer_that_is_no_picture_is_refused(self, arm: RemoteRobot, network: ScriptedNetwork, jpeg: Any) -> None:
        network.answers["getPicture"] = lambda arguments: success("", jpeg=jpeg)
        with pytest.raises(errors.RobotError, match="no picture"):
            arm.picture()


def test_no_verb_of_a_robots_own_has_the_name_of_a_member() -> None:
    members = {name for name in dir(RemoteRobot) if not name.startswith("_")}
    assert members <= {python_name(name) for name in MEMBERS | STOPS}
