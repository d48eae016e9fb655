"""Commands side by side and bounded, events in order, one wake-up for many."""

import asyncio
import json
import logging
import threading
import time

import pytest
from fixtures.waiting import until

from strands_robots.device_connect.backends import dispatch, jsonrpc


def command(method="move", rpc_id=1):
    return json.dumps({"jsonrpc": "2.0", "id": rpc_id, "method": method}).encode()


class Desk:
    """A desk with its answers kept and its handlers held until they are let go."""

    def __init__(self):
        self.answers = {}
        self.open = asyncio.Event()
        self.served = []
        self.replied = set()
        relay = dispatch.relaying(self._handle, str, self._unanswered)
        self.desk = dispatch.CommandDesk("arm-1.cmd", relay, self._answer)

    async def _handle(self, data, reply):
        self.served.append(json.loads(data)["method"])
        await self.open.wait()
        if json.loads(data)["method"] == "forget":
            return
        if json.loads(data)["method"] == "fail":
            raise RuntimeError("broken")
        self.replied.add(reply)
        if json.loads(data)["method"] == "answer and fail":
            raise RuntimeError("broken")

    def _answer(self, reply, data):
        self.answers[reply] = json.loads(data)

    def _unanswered(self, reply):
        return reply not in self.replied


@pytest.fixture
async def desk():
    made = Desk()
    yield made
    await made.desk.close()


async def test_a_command_does_not_wait_for_another(desk):
    desk.desk.accept(command("move"), "a")
    desk.desk.accept(command("getStatus"), "b")
    await until(lambda: desk.served == ["move", "getStatus"])


async def test_a_full_desk_answers_busy_at_once_and_still_takes_stops_and_reads(desk):
    for number in range(dispatch.MAX_COMMANDS):
        desk.desk.accept(command("move"), f"move-{number}")
    desk.desk.accept(command("move", "late"), "late")
    assert desk.answers["late"]["error"]["code"] == jsonrpc.BUSY
    assert desk.answers["late"]["id"] == "late"
    for number, method in enumerate(("stop", "stopMotion", "getStatus", "listPoliciesRunning")):
        desk.desk.accept(command(method), f"urgent-{number}")
    await until(lambda: desk.served[-4:] == ["stop", "stopMotion", "getStatus", "listPoliciesRunning"])
    desk.open.set()
    await until(lambda: len(desk.replied) == dispatch.MAX_COMMANDS + 4)
    desk.desk.accept(command("move"), "again")
    await until(lambda: "again" in desk.replied)


@pytest.mark.parametrize("method", ["forget", "fail"])
async def test_a_handler_that_leaves_its_caller_without_an_answer_is_answered_for(desk, method):
    desk.open.set()
    desk.desk.accept(command(method, 7), "a")
    await until(lambda: "a" in desk.answers)
    assert desk.answers["a"]["error"]["code"] == jsonrpc.INTERNAL_ERROR
    assert desk.answers["a"]["id"] == 7


async def test_whoever_gives_the_reply_need_not_send_it():
    answers = []

    async def serve(command):
        await asyncio.sleep(0)
        if command.params["fail"]:
            raise RuntimeError("broken")
        return jsonrpc.result(command.id, command.method)

    async def send(_reply, data):
        await asyncio.sleep(0)
        answers.append(json.loads(data))

    desk = dispatch.CommandDesk("arm-1.cmd", dispatch.serving(serve), send)
    for number, fail in enumerate((False, True)):
        desk.accept(json.dumps({"id": number, "method": "move", "params": {"fail": fail}}).encode(), "a")
    desk.accept(b"no json", "a")
    desk.accept(json.dumps({"id": 3, "method": "move", "params": {"fail": False}}).encode(), None)
    await until(lambda: len(answers) == 3)
    await desk.close()
    assert {"jsonrpc": "2.0", "id": 0, "result": "move"} in answers
    codes = {each["id"]: each["error"]["code"] for each in answers if "error" in each}
    assert codes == {1: jsonrpc.INTERNAL_ERROR, None: jsonrpc.PARSE_ERROR}


async def test_a_handler_that_fails_after_its_answer_is_not_answered_for(desk):
    desk.open.set()
    desk.desk.accept(command("answer and fail"), "a")
    await until(lambda: "a" in desk.replied)
    await asyncio.sleep(0)
    assert desk.answers == {}


async def test_ten_thousand_bad_messages_cost_one_log_line(desk, caplog):
    began = time.monotonic()
    with caplog.at_level(logging.WARNING, dispatch.logger.name):
        for number in range(10_000):
            desk.desk.accept(b"no json", f"r{number}")
    assert len(desk.answers) == 10_000
    told = [each for each in caplog.records if each.name == dispatch.logger.name]
    assert 1 <= len(told) <= 1 + (time.monotonic() - began), "one line a second"


async def test_closing_the_desk_cancels_what_runs(desk):
    desk.desk.accept(command("move"), "a")
    await until(lambda: desk.served)
    await desk.desk.close()
    assert desk.answers == {}


async def test_events_are_handled_in_the_order_of_their_arrival_even_when_one_fails():
    seen = []

    async def handler(_data, number):
        await asyncio.sleep(0)
        seen.append(number)
        if number == 3:
            raise ValueError(number)

    feed = dispatch.OrderedFeed("s", handler)
    for number in range(1_000):
        feed.accept(b"", number)
    await until(lambda: len(seen) == 1_000)
    await feed.close()
    assert seen == list(range(1_000))


async def test_a_feed_whose_handler_hangs_keeps_the_newest(monkeypatch):
    monkeypatch.setattr(dispatch, "MAX_EVENTS", 10)
    gate, seen = asyncio.Event(), []

    async def handler(_data, number):
        await gate.wait()
        seen.append(number)

    feed = dispatch.OrderedFeed("s", handler)
    feed.accept(b"", 0)
    await asyncio.sleep(0)
    await asyncio.sleep(0)
    for number in range(1, 31):
        feed.accept(b"", number)
    gate.set()
    await until(lambda: len(seen) == 11)
    await feed.close()
    assert seen == [0, *range(21, 31)]


async def test_calls_from_threads_arrive_in_each_threads_order():
    inbox = dispatch.Inbox(asyncio.get_running_loop())
    seen = []

    def talk(name):
        for number in range(2_000):
            inbox.put(seen.append, (name, number))

    threads = [threading.Thread(target=talk, args=(name,)) for name in "ab"]
    for thread in threads:
        thread.start()
    await until(lambda: len(seen) == 4_000)
    for thread in threads:
        thread.join()
    for name in "ab":
        assert [number for who, number in seen if who == name] == list(range(2_000))


def test_a_closed_loop_swallows_what_comes_late():
    loop = asyncio.new_event_loop()
    inbox = dispatch.Inbox(loop)
    loop.close()
    inbox.put(print, "nobody hears this")


async def test_a_feed_keeps_no_more_bytes_than_it_may(monkeypatch):
    monkeypatch.setattr(dispatch, "MAX_WAITING_BYTES", 1_000)
    seen = []

    async def handler(data):
        seen.append(len(data))

    feed = dispatch.OrderedFeed("s", handler)
    for _ in range(5):
        feed.accept(b"x" * 400)
    feed.accept(b"x" * 5_000)
    await until(lambda: seen)
    await feed.close()
    assert seen == [5_000]


async def test_a_feed_takes_messages_from_threads_in_their_order():
    loop, seen = asyncio.get_running_loop(), []

    async def handler(_data, number):
        seen.append(number)

    feed = dispatch.OrderedFeed("s", handler, loop.call_soon_threadsafe)
    thread = threading.Thread(target=lambda: [feed.accept(b"x", number) for number in range(5_000)])
    thread.start()
    await until(lambda: len(seen) == 5_000)
    thread.join()
    await feed.close()
    assert seen == list(range(5_000))


def test_room_runs_out_by_count_and_by_size_and_comes_back():
    room = dispatch.Room(messages=2, size=100)
    assert room.take(50)
    assert not room.take(60)
    assert room.take(50)
    assert not room.take(0)
    room.give_back(50)
    assert room.take(10)
