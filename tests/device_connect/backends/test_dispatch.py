"""Commands side by side and bounded, events in order, one wake-up for many messages."""

import asyncio
import contextlib
import contextvars
import json
import logging
import threading
import time

import pytest
from fixtures.waiting import until

from strands_robots.device_connect.backends import LinkConfig, dispatch, jsonrpc
from strands_robots.device_connect.backends.base import Backend
from strands_robots.device_connect.backends.dispatch import start_now


def command(method="move", rpc_id=1):
    return json.dumps({"jsonrpc": "2.0", "id": rpc_id, "method": method}).encode()


class Server:
    """A command server whose handlers wait until they may go on; keeps its answers and the handlers' replies."""

    def __init__(self):
        self.answers = {}
        self.open = asyncio.Event()
        self.served = []
        self.replied = set()
        self.replies = dispatch.PendingReplies()
        self.serve = dispatch.relaying(self._handle, self.replies)
        self.server = dispatch.CommandServer("arm-1.cmd", self.serve, lambda message: message, self._answer, call_soon)

    def receive(self, data, reply):
        self.server.receive((data, reply))

    async def _handle(self, data, subject):
        method = json.loads(data)["method"]
        self.served.append(method)
        await self.open.wait()
        if method == "forget":
            return
        if method == "fail":
            raise RuntimeError("broken")
        self.replies.take(subject)
        self.replied.add(json.loads(data)["id"])
        if method == "answer and fail":
            raise RuntimeError("broken")

    def _answer(self, reply, data):
        self.answers[reply] = json.loads(data)


def call_soon(function):
    asyncio.get_running_loop().call_soon(function)


@pytest.fixture
async def server():
    made = Server()
    yield made
    await made.server.close()


async def test_command_does_not_wait_for_another(server):
    server.receive(command("move"), "a")
    server.receive(command("getStatus"), "b")
    await until(lambda: server.served == ["move", "getStatus"])


async def test_full_server_answers_busy_and_still_takes_stops_and_reads(server):
    for number in range(dispatch.MAX_COMMANDS):
        server.receive(command("move", number), f"move-{number}")
    server.receive(command("move", "late"), "late")
    await until(lambda: "late" in server.answers)
    assert server.answers["late"]["error"]["code"] == jsonrpc.BUSY
    assert server.answers["late"]["id"] == "late"
    for number, method in enumerate(("stop", "stopMotion", "getStatus", "listPoliciesRunning")):
        server.receive(command(method, method), f"urgent-{number}")
    await until(lambda: server.served[-4:] == ["stop", "stopMotion", "getStatus", "listPoliciesRunning"])
    server.open.set()
    await until(lambda: len(server.replied) == dispatch.MAX_COMMANDS + 4)
    server.receive(command("move", "again"), "again")
    await until(lambda: "again" in server.replied)


async def test_commands_that_arrive_while_the_loop_is_held_up_are_bounded(server):
    for number in range(dispatch.MAX_ARRIVED):
        server.receive(command("getStatus", number), f"waiting-{number}")
    assert server.answers == {}
    server.receive(command("getStatus", "late"), "late")
    assert server.answers["late"]["error"]["code"] == jsonrpc.BUSY


async def test_command_with_too_many_bytes_is_refused_unread(server):
    server.receive(jsonrpc.MAX_COMMAND_BYTES + 1, "large")
    await until(lambda: "large" in server.answers)
    assert server.answers["large"]["error"]["code"] == jsonrpc.INVALID_REQUEST
    assert str(jsonrpc.MAX_COMMAND_BYTES + 1) in server.answers["large"]["error"]["message"]


@pytest.mark.parametrize("method", ["forget", "fail"])
async def test_caller_gets_an_error_when_the_handler_gives_no_answer(server, method):
    server.open.set()
    server.receive(command(method, 7), "a")
    await until(lambda: "a" in server.answers)
    assert server.answers["a"]["error"]["code"] == jsonrpc.INTERNAL_ERROR
    assert server.answers["a"]["id"] == 7


async def test_server_answers_for_a_serve_function_that_fails():
    answers = []

    async def serve(command, answer):
        await asyncio.sleep(0)
        if command.params["fail"]:
            raise RuntimeError("broken")
        await dispatch.send(answer, jsonrpc.result(command.id, command.method))

    async def answer(_reply, data):
        await asyncio.sleep(0)
        answers.append(json.loads(data))

    server = dispatch.CommandServer("arm-1.cmd", serve, lambda message: message, answer, call_soon)
    for number, fail in enumerate((False, True)):
        server.receive((json.dumps({"id": number, "method": "move", "params": {"fail": fail}}).encode(), "a"))
    server.receive((b"no json", "a"))
    server.receive((json.dumps({"id": 3, "method": "move", "params": {"fail": False}}).encode(), None))
    await until(lambda: len(answers) == 3)
    await server.close()
    assert {"jsonrpc": "2.0", "id": 0, "result": "move"} in answers
    codes = {each["id"]: each["error"]["code"] for each in answers if "error" in each}
    assert codes == {1: jsonrpc.INTERNAL_ERROR, None: jsonrpc.PARSE_ERROR}


async def test_caller_gets_no_second_answer_when_the_handler_fails_after_its_own(server):
    server.open.set()
    server.receive(command("answer and fail"), "a")
    await until(lambda: 1 in server.replied)
    await asyncio.sleep(0)
    assert server.answers == {}


async def test_ten_thousand_bad_messages_cost_one_log_line(server, caplog):
    began = time.monotonic()
    with caplog.at_level(logging.WARNING, dispatch.logger.name):
        for number in range(10_000):
            server.receive(b"no json", f"r{number}")
            if number % 1_000 == 0:
                await asyncio.sleep(0)
        await until(lambda: len(server.answers) == 10_000)
    lines = [each for each in caplog.records if each.name == dispatch.logger.name]
    assert 1 <= len(lines) <= 1 + (time.monotonic() - began), "one line a second"


async def test_answer_that_cannot_be_sent_does_not_hold_up_the_next_command(server, caplog):
    def unsendable(_reply, _data):
        raise OSError("the link is gone")

    refusing = dispatch.CommandServer("arm-1.cmd", server.serve, lambda message: message, unsendable, call_soon)
    refusing.receive((b"no json", "a"))
    refusing.receive((command("getStatus"), "b"))
    await until(lambda: server.served == ["getStatus"])
    await refusing.close()
    assert "arm-1.cmd was lost" in caplog.text


async def test_close_cancels_running_commands(server):
    server.receive(command("move"), "a")
    await until(lambda: server.served)
    await server.server.close()
    assert server.answers == {}


async def test_events_are_handled_in_the_order_of_their_arrival_even_when_one_fails():
    seen = []

    async def handler(_data, number):
        await asyncio.sleep(0)
        seen.append(number)
        if number == 3:
            raise ValueError(number)

    feed = dispatch.OrderedFeed("s", handler, call_soon)
    for number in range(1_000):
        feed.accept(b"", number)
    await until(lambda: len(seen) == 1_000)
    await feed.close()
    assert seen == list(range(1_000))


async def test_feed_keeps_the_newest_messages_while_its_handler_hangs(monkeypatch):
    monkeypatch.setattr(dispatch, "MAX_EVENTS", 10)
    gate, seen = asyncio.Event(), []

    async def handler(_data, number):
        await gate.wait()
        seen.append(number)

    feed = dispatch.OrderedFeed("s", handler, call_soon)
    feed.accept(b"", 0)
    await asyncio.sleep(0)
    await asyncio.sleep(0)
    for number in range(1, 31):
        feed.accept(b"", number)
    gate.set()
    await until(lambda: len(seen) == 11)
    await feed.close()
    assert seen == [0, *range(21, 31)]


async def test_backlog_keeps_the_order_of_each_thread_with_few_wake_ups():
    loop, seen, wakes = asyncio.get_running_loop(), [], []

    def drain():
        wakes.append(1)
        while (message := backlog.take()) is not None:
            seen.append(message)

    backlog = dispatch.Backlog(lambda: loop.call_soon_threadsafe(drain))

    def talk(name):
        for number in range(2_000):
            assert backlog.offer((name, number))

    threads = [threading.Thread(target=talk, args=(name,)) for name in "ab"]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    await until(lambda: len(seen) == 4_000)
    assert len(wakes) == 1
    for name in "ab":
        assert [number for each, number in seen if each == name] == list(range(2_000))


async def test_feed_keeps_no_more_bytes_than_it_may(monkeypatch):
    monkeypatch.setattr(dispatch, "MAX_WAITING_BYTES", 1_000)
    seen = []

    async def handler(data):
        seen.append(len(data))

    feed = dispatch.OrderedFeed("s", handler, call_soon)
    for _ in range(5):
        feed.accept(b"x" * 400)
    feed.accept(b"x" * 5_000)
    await until(lambda: seen)
    await feed.close()
    assert seen == [5_000]


@pytest.mark.parametrize(
    "data", [2_000, b"x" * 1_001, b"[" + b"[]," * 30_000 + b"0]"], ids=["number", "length", "lists"]
)
async def test_feed_drops_what_is_out_of_bounds_or_gives_what_stands_for_it(data, caplog):
    seen, stood = [], []

    async def handler(message):
        seen.append(message)

    async def other(message):
        stood.append(message)

    longest = 1_000 if not isinstance(data, bytes) or len(data) < 2_000 else 2**20
    feed = dispatch.OrderedFeed("s", handler, call_soon, longest=longest)
    standing = dispatch.OrderedFeed("s", other, call_soon, longest=longest, unread=lambda size: size)
    for message in (data, b"x" * 1_000):
        feed.accept(message)
        standing.accept(message)
    await until(lambda: seen and len(stood) == 2)
    await feed.close()
    await standing.close()
    assert seen == [b"x" * 1_000]
    assert stood == [data if isinstance(data, int) else len(data), b"x" * 1_000]
    assert "refused a message on s" in caplog.text


async def test_foreign_handler_of_stops_gets_a_short_one_for_one_that_is_too_long():
    seen = []

    async def handler(data, reply):
        seen.append(json.loads(data))

    class Loopback(Backend):
        def _call_soon(self, function):
            call_soon(function)

        async def _declare(self, subject, queue, consumer, **options):
            consumer.accept(8_000_000, None)
            consumer.accept(b"x" * 70_000, None)

            async def undo():
                pass

            return undo

    Loopback.__abstractmethods__ = frozenset()  # the others are not called
    client = Loopback(LinkConfig())
    subscription = await client.subscribe("device-connect.default.*.event.emergencyStop", handler, subscribe_only=True)
    await until(lambda: len(seen) == 2)
    await subscription.unsubscribe()
    assert [each["method"] for each in seen] == ["emergencyStop"] * 2
    assert "8000000 bytes" in seen[0]["params"]["reason"]
    assert seen[0]["params"]["event_id"] != seen[1]["params"]["event_id"]


async def test_feed_takes_messages_from_threads_in_their_order():
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


def test_backlog_refuses_by_count_and_by_size_and_takes_again():
    backlog = dispatch.Backlog(lambda: None, messages=2, size=100)
    assert backlog.offer("a", 50)
    assert not backlog.offer("b", 60)
    assert backlog.offer("b", 50)
    assert not backlog.offer("c", 0)
    assert backlog.take() == "a"
    assert backlog.offer("c", 10)


def test_replies_expire_and_are_taken_once():
    replies = dispatch.PendingReplies()
    old, command = replies.expect(print, within_s=-1.0), replies.expect(print)
    recent = replies.expect(print, within_s=60.0)
    assert replies.take(old) is None
    assert replies.take(command) is replies.take(recent) is print
    assert replies.take(command) is None


VARIABLE_OF_A_TASK = contextvars.ContextVar("VARIABLE_OF_A_TASK", default="")


def at_once(work):
    """Start ``work`` from a plain callback, where no task runs."""
    started = asyncio.get_running_loop().create_future()

    def start():
        task = start_now(work)
        started.set_result((task, seen_at_start()))

    seen = []

    def seen_at_start():
        return list(seen)

    asyncio.get_running_loop().call_soon(start)
    return started, seen


async def test_work_that_does_not_wait_is_done_when_start_returns():
    async def work():
        seen.append("done")

    started, seen = at_once(coroutine := work())
    task, at_start = await started
    assert at_start == ["done"]
    assert await task is None
    assert coroutine.cr_frame is None


async def test_work_that_waits_continues_later():
    gate = asyncio.Event()

    async def work():
        seen.append(1)
        await gate.wait()
        seen.append(2)
        await asyncio.sleep(0)
        await asyncio.sleep(0.001)
        seen.append(3)

    started, seen = at_once(work())
    task, at_start = await started
    assert at_start == [1]
    gate.set()
    await task
    assert seen == [1, 2, 3]


async def test_bare_yield_comes_first():
    async def work():
        await asyncio.sleep(0)
        seen.append(1)

    started, seen = at_once(work())
    await (await started)[0]
    assert seen == [1]


async def test_task_is_current_from_its_first_step_so_timeouts_work():
    async def work():
        first = asyncio.current_task()
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(0.01):
                await asyncio.sleep(5)
        seen.extend((first, asyncio.current_task()))

    started, seen = at_once(work())
    task, _ = await started
    await task
    assert seen == [task, task]


@pytest.mark.parametrize("wait_first", [False, True])
async def test_exception_is_the_tasks_outcome(wait_first):
    async def work():
        if wait_first:
            await asyncio.sleep(0.001)
        raise ValueError("broken")

    started, _ = at_once(work())
    task, _ = await started
    with pytest.raises(ValueError, match="broken"):
        await task


@pytest.mark.parametrize("let_it_run", [False, True])
async def test_cancelled_task_cleans_up_and_cancels_its_future(let_it_run):
    loop, seen = asyncio.get_running_loop(), []
    inner = loop.create_future()

    async def work():
        try:
            await inner
        finally:
            seen.append("cleaned up")

    def start():
        task = start_now(work())
        if let_it_run:
            loop.call_soon(loop.call_soon, task.cancel)
        else:
            task.cancel()
        seen.append(task)

    loop.call_soon(start)
    await until(lambda: "cleaned up" in seen)
    task = seen[0]
    await asyncio.wait({task})
    assert task.cancelled()
    assert inner.cancelled()


async def test_command_that_cancels_itself_in_its_first_step_is_ended_by_close():
    loop, seen = asyncio.get_running_loop(), []

    async def serve(arrived, answer):
        if arrived.method == "first":
            seen.append("first")
            return
        asyncio.current_task().cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await loop.create_future()
        seen.append("goes on")
        try:
            await loop.create_future()
        finally:
            seen.append("ended")

    server = dispatch.CommandServer("arm-1.cmd", serve, lambda data: (data, None), print, call_soon)
    server.receive(command("first"))
    await until(lambda: seen == ["first"])
    server.receive(command("second"))
    await until(lambda: seen[1:] == ["goes on"])
    await server.close()
    assert seen == ["first", "goes on", "ended"]


async def test_done_callback_runs_when_work_ends_in_its_first_step():
    async def work():
        asyncio.current_task().add_done_callback(lambda _: seen.append("called"))

    started, seen = at_once(work())
    await started
    await until(lambda: seen == ["called"])


async def test_context_variable_set_inside_stays_inside_and_lasts():
    async def work():
        token = VARIABLE_OF_A_TASK.set("inside")
        await asyncio.sleep(0.001)
        seen.append(VARIABLE_OF_A_TASK.get())
        VARIABLE_OF_A_TASK.reset(token)

    started, seen = at_once(work())
    await (await started)[0]
    assert seen == ["inside"]
    assert VARIABLE_OF_A_TASK.get() == ""


async def test_work_started_inside_a_task_begins_in_the_next_turn():
    seen = []

    async def work():
        seen.append(asyncio.current_task())

    task = start_now(work())
    assert not seen
    await task
    assert seen == [task]


async def test_feed_takes_no_more_than_so_many_messages_a_second():
    seen = []

    async def handler(_data, number):
        seen.append(number)

    feed = dispatch.OrderedFeed("s", handler, call_soon, per_s=10)
    for number in range(1_000):
        feed.accept(b"x", number)
    await until(lambda: len(seen) >= 10)
    await feed.close()
    assert seen[:10] == list(range(10))
    assert len(seen) < 1_000
