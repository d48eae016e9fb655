"""The page's server alone: files, WebSockets, roles and strangers."""

from __future__ import annotations

import asyncio
import json
import re
from collections.abc import AsyncIterator, Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from fixtures.page_feed import JPEG, PageFeed, page_feeds
from fixtures.waiting import eventually
from starlette.testclient import TestClient, WebSocketTestSession
from starlette.websockets import WebSocketDisconnect

from strands_robots.dashboard import page_session, server
from strands_robots.dashboard.access import OPERATOR, VIEWER, Access, KeyRefusedError, OperatorKey, loopback_origins
from strands_robots.dashboard.fleet_model import FleetModel
from strands_robots.dashboard.pictures import Pictures, Poses
from strands_robots.dashboard.server import STATIC, Dashboard
from strands_robots.envelope import error, success
from strands_robots.safety.answers import Answer
from strands_robots.safety.ed25519 import keygen
from strands_robots.safety.network_key import NetworkKey
from strands_robots.safety.sightings import sightings

ORIGIN = "http://127.0.0.1:8800"
PASSPHRASE = "Plenty of 4 different words"
FORMS = (
    {"name": "execute", "kind": "motion", "lasts_s": 0.0, "summary": "", "parameters": []},
    {"name": "getPose", "kind": "read", "lasts_s": 0.0, "summary": "", "parameters": []},
    {"name": "getPicture", "kind": "read", "lasts_s": 0.0, "summary": "", "parameters": []},
)


class Site:
    """A server with one robot, and a browser that opens pages on it."""

    def __init__(self, client: TestClient, model: FleetModel, feed: PageFeed, page: Dashboard) -> None:
        self.client, self.model, self.feed, self.page = client, model, feed, page

    def open(self, path: str, **headers: str) -> WebSocketTestSession:
        return self.client.websocket_connect(f"ws://127.0.0.1:8800{path}", headers=headers or {"origin": ORIGIN})


Make = Callable[..., Site]


@pytest.fixture
def make(tmp_path: Path) -> Iterator[Make]:
    stack: list[Any] = []

    def made(access: Access | None = None, client: str = "127.0.0.1", key: Path | None = None) -> Site:
        model, feed = FleetModel(), PageFeed()
        model.update("dc", "arm-1", kind="strands_robot", forms=FORMS, expected=True)
        page = Dashboard(model, page_feeds(model, feed), access or Access(loopback_origins(8800)), OperatorKey(key))
        browser = TestClient(page.app(), base_url=ORIGIN, client=(client, 4000))
        stack.append(browser)
        browser.__enter__()
        return Site(browser, model, feed, page)

    yield made
    for each in stack:
        each.__exit__(None, None, None)


def hello(socket: WebSocketTestSession, token: str | None = None) -> Any:
    socket.send_json({"type": "hello", "token": token})
    return received(socket, "hello")


def received(socket: WebSocketTestSession, kind: str) -> Any:
    """The next message of a kind; others are let pass."""
    while True:
        message = socket.receive()
        if message["type"] == "websocket.close":
            raise WebSocketDisconnect(message["code"])
        if message.get("text"):
            found = json.loads(message["text"])
            if found["type"] == kind:
                return found


def asked(socket: WebSocketTestSession, **message: Any) -> Any:
    socket.send_json({"id": 1, **message})
    return received(socket, "answer")


# Files.


def test_page_and_all_its_parts_come_from_the_wheel_and_from_one_origin(make: Make) -> None:
    site = make()
    seen, waiting = set(), {"/"}
    while waiting:
        path = waiting.pop()
        seen.add(path)
        answer = site.client.get(path)
        assert answer.status_code == 200, path
        named = re.findall(r"""(?:src|href)="([^"#]+)"|from "\./([^"]+)"|url\(([^)]+)\)""", answer.text)
        waiting |= {f"/{name}" for each in named for name in each if name} - seen
    assert seen - {"/"} == {f"/{path.name}" for path in STATIC.iterdir() if path.name != "index.html"}


def test_page_weighs_at_most_300_kilobytes() -> None:
    assert sum(path.stat().st_size for path in STATIC.iterdir()) <= 300_000


def test_page_has_no_inline_script_no_markup_from_text_and_no_other_address() -> None:
    for path in STATIC.iterdir():
        text = path.read_text(encoding="utf-8")
        assert not re.search(r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|eval\(|new Function", text), path
        assert not re.search(r"https?://(?!www\.w3\.org/2000/svg)", text), path
    assert not re.search(r"<script(?![^>]*src=)|\son\w+=|<style|style=", (STATIC / "index.html").read_text())


def test_every_answer_forbids_inline_script_framing_and_other_origins(make: Make) -> None:
    site = make()
    for path in ("/", "/main.js", "/nothing", "/camera"):
        policy = site.client.get(path).headers["content-security-policy"]
        assert "default-src 'none'" in policy and "script-src 'self';" in policy and "frame-ancestors 'none'" in policy
        assert "unsafe" not in policy and "*" not in policy
        assert "set-cookie" not in site.client.get(path).headers


# Strangers.


@pytest.mark.parametrize("path", ["/", "/state", "/stop", "/camera", "/main.js"])
def test_request_by_another_name_or_from_another_site_is_refused(make: Make, path: str) -> None:
    site = make()
    for headers in ({"host": "evil.example"}, {"origin": "http://evil.example"}, {"sec-fetch-site": "cross-site"}):
        assert site.client.get(path, headers=headers).status_code == 403


def test_only_get_is_served(make: Make) -> None:
    site = make()
    for method in ("POST", "PUT", "DELETE", "OPTIONS", "PATCH"):
        assert site.client.request(method, "/", headers={"origin": ORIGIN}).status_code == 403


@pytest.mark.parametrize("path", ["/state", "/stop"])
@pytest.mark.parametrize(
    "headers", [{"origin": "http://evil.example"}, {"origin": "null"}, {"x": "no origin"}, {"host": "evil.example"}]
)
def test_websocket_of_a_stranger_is_refused_before_it_is_open(make: Make, path: str, headers: dict[str, str]) -> None:
    site = make()
    with site.open(path) as own:
        assert own is not None
    with pytest.raises(WebSocketDisconnect), site.open(path, **headers):
        pytest.fail("it was opened")
    assert site.feed.controller.presses == []


def test_wrong_token_opens_nothing_and_stops_nothing(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server, "WRONG_TOKEN_S", 0.0)
    origins = loopback_origins(8800)
    site = make(Access(origins, {"right": OPERATOR}), client="10.0.0.7")
    for token in (None, "", "wrong"):
        for path in ("/state", "/stop"):
            with pytest.raises(WebSocketDisconnect) as refused, site.open(path) as socket:
                socket.send_json({"type": "hello", "token": token})
                socket.send_json({"type": "stop"})
                received(socket, "hello")
            assert refused.value.code == 4401
    assert site.feed.controller.presses == []


def test_camera_needs_the_ticket_of_an_open_page(make: Make) -> None:
    site = make()
    assert site.client.get("/camera?robot=dc:arm-1").status_code == 403
    with site.open("/state") as socket:
        ticket = hello(socket)["ticket"]
        assert site.client.get(f"/camera?robot=dc:none&ticket={ticket}").status_code == 404
    assert eventually(lambda: site.client.get(f"/camera?robot=dc:arm-1&ticket={ticket}").status_code == 403)


def test_garbage_on_a_websocket_does_nothing(make: Make) -> None:
    site = make()
    with site.open("/state") as socket:
        hello(socket)
        for text in (
            "",
            "null",
            "[1]",
            "{",
            '{"type": 7}',
            '{"type": "call", "key": 3}',
            '{"type": "jog"}',
            "[" * 5000,
        ):
            socket.send_text(text)
        assert "No robot" in asked(socket, type="call", key="dc:nobody", verb="execute", params={})["text"]
    assert [each for each in site.feed.calls if each[1] == "execute"] == []


# Roles.


def test_viewer_may_look_and_stop_and_move_nothing(make: Make) -> None:
    site = make(Access(loopback_origins(8800), {}, VIEWER))
    with site.open("/state") as socket, site.open("/stop") as stop:
        assert hello(socket)["role"] == VIEWER
        assert asked(socket, type="call", key="dc:arm-1", verb="getPose", params={})["ok"]
        for message in (
            {"type": "call", "verb": "execute", "params": {}},
            {"type": "take"},
            {"type": "lead", "policy": "mock", "task": "wave"},
            {"type": "forget"},
            {"type": "resume", "keys": ["dc:arm-1"], "passphrase": "x"},
        ):
            assert "viewer" in asked(socket, key="dc:arm-1", **message)["text"]
        socket.send_json({"type": "jog", "key": "dc:arm-1", "kind": "joint", "axis": "pan", "direction": 1})
        assert received(socket, "jogged")["refused"]
        stop.send_json({"type": "hello"})
        stop.send_json({"type": "stop", "id": 1})
        received(stop, "pressed")
    assert len(site.feed.controller.presses) == 1
    assert {name for _, name, _ in site.feed.calls} == {"getPose"}


def test_page_whose_state_cannot_be_sent_any_more_loses_its_connection(
    make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    site = make()
    with site.open("/state") as socket:
        hello(socket)

        def broken(*_: object) -> tuple[int, str]:
            raise ValueError("Out of range float values are not JSON compliant")

        monkeypatch.setattr(site.model, "changes", broken)
        with pytest.raises(WebSocketDisconnect) as closed:
            received(socket, "never")
        assert closed.value.code == 1011


def test_verbs_that_a_robot_describes_later_are_told_to_the_page_that_looks_at_it(make: Make) -> None:
    site = make()
    with site.open("/state") as socket:
        hello(socket)
        socket.send_json({"type": "watch", "key": "dc:arm-1"})
        while not received(socket, "robot")["looked"]:
            pass
        site.model.update("dc", "arm-1", forms=FORMS[:1])
        assert [form["name"] for form in received(socket, "robot")["forms"]] == ["execute"]


def test_networks_that_are_missing_are_told_with_the_reason(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    site = make()
    monkeypatch.setattr(type(site.page.feeds), "missing", {"mesh": "no mesh answers"})
    with site.open("/stop") as stop:
        stop.send_json({"type": "hello"})
        told = received(stop, "link")
    assert (told["missing"], told["can_stop"]) == ({"mesh": "no mesh answers"}, True)


def test_verb_that_the_robot_does_not_describe_is_not_called(make: Make) -> None:
    site = make()
    with site.open("/state") as socket:
        hello(socket)
        for verb in ("releaseTorque", "resume", "acquireControl", "", "requestRegistration"):
            assert not asked(socket, type="call", key="dc:arm-1", verb=verb, params={})["ok"]
    assert site.feed.calls == []


# STOP.


def test_press_is_sent_once_confirmed_and_answered_by_name(make: Make) -> None:
    site = make()
    site.feed.controller.verdicts = {"arm-1": Answer("arm-1", False, 7.0, "no brakes")}
    with site.open("/stop") as stop, site.open("/state") as socket:
        hello(socket)
        stop.send_json({"type": "hello"})
        assert received(stop, "link")["can_stop"] is True
        stop.send_json({"type": "stop", "id": 5, "robot": "arm-1"})
        assert received(stop, "pressed")["id"] == 5

        def verdict() -> Any:
            rows = received(socket, "fleet")["rows"]
            return next((row["stop"] for row in rows if row["stop"]), None)

        found = eventually(verdict)
    assert (found["state"], found["why"]) == ("not_stopped", "no brakes")
    assert len(site.feed.controller.presses) == 1


@pytest.mark.parametrize(
    ("scope", "pressed"),
    [
        ({"cell": "cell-1"}, "cell cell-1 and robots without a cell"),
        ({"only": "dc:arm-1"}, "arm-1 only"),
        ({}, ""),
        ({"cell": "cell-1", "only": "dc:arm-1"}, ""),
        ({"cell": "cell-9"}, ""),
        ({"cell": 7}, ""),
        ({"only": "dc:nobody"}, ""),
    ],
)
def test_press_with_a_scope_that_is_not_known_is_for_all(make: Make, scope: dict[str, Any], pressed: str) -> None:
    site = make()
    site.model.update("dc", "arm-1", cell="cell-1")
    with site.open("/stop") as stop:
        for message in ({"type": "hello"}, {"type": "stop", "id": 1, **scope}):
            stop.send_json(message)
        received(stop, "pressed")
        assert site.page.stop.state()["pressed_for"] == pressed
    assert len(site.feed.controller.presses) == 1


@pytest.mark.parametrize(
    ("answer", "stopped"),
    [
        (success("Stopped.", stopped=True), True),
        (error("no brakes", stopped=False), False),
        (error("no answer", stopped=None), "unknown"),
    ],
)
def test_halt_is_in_the_timeline_with_its_outcome_and_who_halted(make: Make, answer: Any, stopped: object) -> None:
    site = make(Access(loopback_origins(8800), {}, VIEWER))
    site.feed.stop_answer = answer
    with site.open("/state") as socket:
        hello(socket)
        asked(socket, type="call", key="dc:arm-1", verb="stop", params={})
    entry = json.loads(site.model.changes(0)[1])["events"][-1]
    assert (entry["event"], entry["key"]) == ("halted here", "dc:arm-1")
    assert entry["facts"] == {"by": "viewer, 127.0.0.1", "stopped": stopped}


def test_page_is_told_five_times_a_second_that_its_stop_would_leave(make: Make) -> None:
    site = make()
    with site.open("/stop") as stop:
        stop.send_json({"type": "hello"})
        assert received(stop, "link")["links"] == {"dc": True}
        site.feed.controller.link_up = False
        eventually(lambda: not received(stop, "link")["can_stop"])
    assert server.LINK_S <= 0.25


# Resume.


def test_resume_takes_the_passphrase_and_the_machine_of_the_server(make: Make, tmp_path: Path) -> None:
    key = tmp_path / "operator.pem"
    keygen(key, PASSPHRASE)
    site = make(key=key)
    with site.open("/state") as socket:
        assert hello(socket)["operator_key"] is True
        for wrong in ("", "wrong", None, 7):
            assert not asked(socket, type="resume", key="", keys=["dc:arm-1"], passphrase=wrong)["ok"]
        assert site.feed.resumed == []
        assert asked(socket, type="resume", key="", keys=["dc:arm-1"], passphrase=PASSPHRASE)["ok"]
    assert site.feed.resumed == ["arm-1"]


def test_resume_names_the_robots_of_the_roster_that_are_not_heard(make: Make, tmp_path: Path) -> None:
    key = tmp_path / "operator.pem"
    keygen(key, PASSPHRASE)
    site = make(key=key)
    network = site.feed.controller.network = NetworkKey.of("device-connect", ["tcp/127.0.0.1:7447"])
    sightings().note(network, "arm-9", stoppable=True)
    assert sightings().flush(20.0)
    with site.open("/state") as socket:
        assert hello(socket)["operator_key"] is True
        said = asked(socket, type="resume", key="", keys=["dc:arm-1"], passphrase=PASSPHRASE)
    assert said["ok"]
    assert "NOT HEARD: arm-9." in said["text"]


def test_resume_from_another_machine_is_refused(make: Make, tmp_path: Path) -> None:
    key = tmp_path / "operator.pem"
    keygen(key, PASSPHRASE)
    site = make(Access(loopback_origins(8800), {"right": OPERATOR}), client="10.0.0.7", key=key)
    with site.open("/state") as socket:
        hello(socket, "right")
        said = asked(socket, type="resume", key="", keys=["dc:arm-1"], passphrase=PASSPHRASE)
    assert "own machine" in said["text"]
    assert site.feed.resumed == []


def test_wrong_passphrases_are_counted(tmp_path: Path) -> None:
    key = tmp_path / "operator.pem"
    keygen(key, PASSPHRASE)
    opened = OperatorKey(key)
    for _ in range(5):
        with pytest.raises(KeyRefusedError, match="does not open"):
            opened.open("wrong")
    with pytest.raises(KeyRefusedError, match="none is tried"):
        opened.open(PASSPHRASE)


# Pictures.


def test_thumbnails_of_the_visible_cards_are_pushed(make: Make) -> None:
    site = make()
    with site.open("/state") as socket:
        hello(socket)
        socket.send_json({"type": "thumbnails", "keys": ["dc:arm-1"]})
        while not (message := socket.receive()).get("bytes"):
            pass
    data = message["bytes"]
    length = int.from_bytes(data[:2], "big")
    assert (data[2 : 2 + length], data[2 + length :]) == (b"dc:arm-1", JPEG)


def pose_said(socket: WebSocketTestSession) -> str:
    return str(received(socket, "pose")["why"])


def test_page_is_told_why_no_pose_is_drawn_at_every_change(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(page_session, "POSE_AGAIN_S", 0.01)
    monkeypatch.setattr(page_session, "UNKNOWN_AGAIN_S", 0.01)
    site, drawn = make(), success("the pose", jpeg="")
    answers = [drawn, drawn, error("the bus is lost"), error("the bus is lost"), drawn]

    async def picture(*_: object) -> Any:
        return answers.pop(0) if len(answers) > 1 else answers[0]

    monkeypatch.setattr(Poses, "picture", picture)
    with site.open("/state") as socket:
        hello(socket)
        socket.send_json({"type": "watch", "key": "dc:arm-2"})
        assert pose_said(socket) == "the robot is not known yet."
        site.model.update("dc", "arm-2", kind="strands_robot")
        site.model.update("dc", "arm-2", forms=FORMS)
        assert [pose_said(socket) for _ in range(3)] == ["", "the bus is lost", ""]


def test_pictures_end_for_their_viewers_when_the_server_ends() -> None:
    async def looked() -> list[bytes]:
        pictures, feed = Pictures(), PageFeed()
        feed.answers["getPicture"] = [error("none")]
        waiting = asyncio.create_task(collected(pictures.camera(feed, "arm-1", "blind")))
        await asyncio.to_thread(eventually, lambda: feed.calls, 60.0, what="the question")
        pictures.close()
        seen = await asyncio.wait_for(waiting, 60.0)
        return seen + await asyncio.wait_for(collected(pictures.camera(feed, "arm-1", "front")), 60.0)

    async def collected(frames: AsyncIterator[bytes]) -> list[bytes]:
        return [frame async for frame in frames]

    assert asyncio.run(looked()) == []


def test_page_that_has_gone_gives_its_robots_back(make: Make) -> None:
    site = make()
    with site.open("/state") as socket:
        hello(socket)
        assert asked(socket, type="take", key="dc:arm-1")["ok"]
    eventually(lambda: site.feed.asked("releaseControl"))
    assert site.feed.stops == 1


def test_answers_hold_no_secret_and_have_a_bound(make: Make) -> None:
    site = make()
    site.feed.answers["getPose"] = [{"status": "success", "lease_id": "secret", "long": "x" * 50_000}]
    with site.open("/state") as socket:
        hello(socket)
        answer = asked(socket, type="call", key="dc:arm-1", verb="getPose", params={})
    assert "secret" not in json.dumps(answer) and len(json.dumps(answer)) < page_session.ANSWER_MAX


def test_audit_records_are_read_as_they_are_appended(tmp_path: Path) -> None:
    log = tmp_path / "log"
    log.write_text('{"event": "a"}\n{"eve')
    records, at = server._new_records(log, 0)
    assert [each["event"] for each in records] == ["a"]
    with log.open("a") as file:
        file.write('nt": "b"}\nnot json\n')
    assert [each["event"] for each in server._new_records(log, at)[0]] == ["b"]


def test_what_happened_leaves_out_the_renewals_of_the_pages_leases(make: Make) -> None:
    site = make()
    log = server.audit.audit_directory() / server.AUDIT_FILE
    log.parent.mkdir(parents=True, exist_ok=True)

    def told() -> bool:
        with log.open("a") as file:
            for action in ("renewControl", "tell"):
                record = {"event": "command_executed", "peer_id": "arm-1", "payload": {"action": action}}
                file.write(json.dumps(record) + "\n")
        return '"tell"' in site.model.changes(0)[1]

    eventually(told, what="the audit on the page")
    assert "renewControl" not in site.model.changes(0)[1]
