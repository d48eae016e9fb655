"""The floor under a stop: one message from a publisher to a callback in another process, on the bare transport.

``python -m benchmarks.safety_raw '["zenoh", "tcp/127.0.0.1:PORT"]'`` is the receiving process.
"""

from __future__ import annotations

import asyncio
import json
import sys
import threading
import time
from typing import Any

from fixtures.child import Child, serve
from fixtures.waiting import eventually, free_port

SPACING_S = 0.02
"""Between two messages: as far apart as stops are, so that nothing is warm that is cold for a stop."""


def publish_to_callback(transport: str, url: str, count: int) -> list[float]:
    """Seconds of each of ``count`` messages."""
    where = url if transport == "nats" else f"tcp/127.0.0.1:{free_port()}"
    send, close = (_nats_sender if transport == "nats" else _zenoh_sender)(where)
    try:
        with Child("benchmarks.safety_raw", {"transport": transport, "url": where}) as receiver:

            def linked() -> bool:
                send(-1)
                return "-1" in receiver.ask("heard")

            eventually(linked, 10, "the raw link")
            sent = {}
            for number in range(count):
                sent[str(number)] = time.monotonic()
                send(number)
                time.sleep(SPACING_S)
            heard = receiver.ask("heard")
            return [heard[number] - at for number, at in sent.items()]
    finally:
        close()


def _zenoh(config: dict[str, Any]) -> Any:
    import zenoh  # noqa: PLC0415 - only the transport in use

    quiet = {"scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}}, "mode": "peer"}
    return zenoh.open(zenoh.Config.from_json5(json.dumps({**quiet, **config})))


def _zenoh_sender(url: str) -> tuple[Any, Any]:
    session = _zenoh({"listen": {"endpoints": [url]}})
    return lambda number: session.put("raw/stop", str(number)), session.close


def _nats_sender(url: str) -> tuple[Any, Any]:
    import nats  # noqa: PLC0415 - only the transport in use

    loop = asyncio.new_event_loop()
    threading.Thread(target=loop.run_forever, daemon=True).start()
    client = asyncio.run_coroutine_threadsafe(nats.connect(url), loop).result(10)

    def send(number: int) -> None:
        asyncio.run_coroutine_threadsafe(client.publish("raw.stop", str(number).encode()), loop)

    def close() -> None:
        asyncio.run_coroutine_threadsafe(client.close(), loop).result(10)
        loop.call_soon_threadsafe(loop.stop)

    return send, close


def _receive(transport: str, url: str) -> None:
    heard: dict[str, float] = {}

    def note(payload: bytes) -> None:
        heard[payload.decode()] = time.monotonic()

    if transport == "zenoh":
        session = _zenoh({"connect": {"endpoints": [url]}, "listen": {"endpoints": []}})
        session.declare_subscriber("raw/stop", lambda sample: note(sample.payload.to_bytes()))
        serve({"heard": lambda: heard})
        session.close()
        return
    loop = asyncio.new_event_loop()
    threading.Thread(target=loop.run_forever, daemon=True).start()

    async def subscribe() -> None:
        import nats  # noqa: PLC0415 - only the transport in use

        client = await nats.connect(url)

        async def on_message(message: Any) -> None:
            note(message.data)

        await client.subscribe("raw.stop", cb=on_message)
        await client.flush()

    asyncio.run_coroutine_threadsafe(subscribe(), loop).result(10)
    serve({"heard": lambda: heard})


if __name__ == "__main__":
    _order = json.loads(sys.argv[1])
    _receive(_order["transport"], _order["url"])
