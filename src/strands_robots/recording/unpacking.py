"""Records of an MCAP file, unpacked within bounds.

A few kilobytes can unpack to gigabytes. A chunk may unpack to :data:`CHUNK_MAX_BYTES`, and a file to
:data:`RATIO_MAX` times its own size besides one such chunk.
"""

from __future__ import annotations

import io
import os
from collections.abc import Iterator
from typing import Any, BinaryIO

from strands_robots.utils import ValidationError

CHUNK_MAX_BYTES = 64 * 2**20
RATIO_MAX = 200


def read_messages(file: BinaryIO) -> Iterator[tuple[Any, Any, Any]]:
    """Yield schema, channel and message of each message, in the order of writing.

    Raises:
        ValidationError: it unpacks to more than a recording does.
        McapError, EndOfFile, struct.error: it is no MCAP file, or was cut off.
    """
    from mcap.exceptions import McapError  # noqa: PLC0415 - an extra
    from mcap.records import Channel, Chunk, Message, Schema  # noqa: PLC0415
    from mcap.stream_reader import StreamReader  # noqa: PLC0415

    schemas: dict[int, Any] = {}
    channels: dict[int, Any] = {}
    left = CHUNK_MAX_BYTES + RATIO_MAX * os.fstat(file.fileno()).st_size
    stream = StreamReader(file, emit_chunks=True, record_size_limit=CHUNK_MAX_BYTES)
    for each in stream.records:
        if isinstance(each, Chunk):
            each.data = _unpacked(each, min(left, CHUNK_MAX_BYTES))
            each.compression = ""
            left -= len(each.data)
        for record in _records(each.data) if isinstance(each, Chunk) else [each]:
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Message):
                channel = channels.get(record.channel_id)
                if channel is None:
                    raise McapError(f"no channel record found with id {record.channel_id}")
                yield schemas.get(channel.schema_id), channel, record


def _records(data: bytes) -> Iterator[Any]:
    """Yield the records of a chunk one at a time; it may have millions."""
    from mcap.data_stream import ReadDataStream  # noqa: PLC0415 - an extra
    from mcap.opcode import Opcode  # noqa: PLC0415 - likewise
    from mcap.records import Channel, Message, Schema  # noqa: PLC0415 - likewise

    stream = ReadDataStream(io.BytesIO(data))
    while stream.count < len(data):
        opcode, length = stream.read1(), stream.read8()
        if opcode == Opcode.CHANNEL:
            yield Channel.read(stream)
        elif opcode == Opcode.MESSAGE:
            yield Message.read(stream, length)
        elif opcode == Opcode.SCHEMA:
            yield Schema.read(stream)
        else:
            stream.read(length)


def _unpacked(chunk: Any, limit: int) -> bytes:
    """Return the bytes of a chunk, at most ``limit``, whatever its header claims."""
    if chunk.compression == "zstd":
        import zstandard  # noqa: PLC0415 - comes with mcap

        try:
            with zstandard.ZstdDecompressor(max_window_size=CHUNK_MAX_BYTES).stream_reader(chunk.data) as reader:
                data = reader.read(limit + 1)
        except zstandard.ZstdError as exc:
            raise ValidationError(f"a chunk cannot be unpacked: {exc}") from exc
    elif chunk.compression == "lz4":
        from lz4.frame import LZ4FrameDecompressor  # noqa: PLC0415

        try:
            data = LZ4FrameDecompressor().decompress(chunk.data, max_length=limit + 1)
        except RuntimeError as exc:
            raise ValidationError(f"a chunk cannot be unpacked: {exc}") from exc
    elif chunk.compression:
        raise ValidationError(f"a chunk is packed with {chunk.compression!r}, not with zstd or lz4")
    else:
        data = chunk.data
    if len(data) > limit:
        raise ValidationError(f"a chunk unpacks to more than {limit} bytes")
    return bytes(data)
