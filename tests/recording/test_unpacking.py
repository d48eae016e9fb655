"""A small recording that unpacks to gigabytes is refused before it does."""

from __future__ import annotations

import resource
import struct
import time
import tracemalloc
from pathlib import Path

import pytest
import zstandard
from lz4 import frame as lz4
from mcap.writer import CompressionType, Writer

from strands_robots.recording import file as recording_file
from strands_robots.recording import schemas
from strands_robots.recording.file import read_items, recorded_actions
from strands_robots.utils import ValidationError

MAGIC = bytes([137, 77, 67, 65, 80, 48, 13, 10])


def record(opcode: int, content: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(content)) + content


def text(value: str) -> bytes:
    return struct.pack("<I", len(value)) + value.encode()


def chunk(compression: str, data: bytes, claimed: int) -> bytes:
    head = struct.pack("<QQQI", 0, 0, claimed, 0) + text(compression)
    return record(6, head + struct.pack("<Q", len(data)) + data)


def bomb(compression: str, unpacked: int) -> bytes:
    """Return packed records of an unknown kind, a MiB each, all zeros."""
    piece = record(0x80, bytes(2**20 - 9))
    if compression == "zstd":
        packer = zstandard.ZstdCompressor(level=19).compressobj()
        return b"".join(packer.compress(piece) for _ in range(unpacked // len(piece))) + packer.flush()
    with_lz4 = lz4.LZ4FrameCompressor()
    start = with_lz4.begin()
    return start + b"".join(with_lz4.compress(piece) for _ in range(unpacked // len(piece))) + with_lz4.flush()


def mcap_file(path: Path, *chunks: bytes) -> Path:
    path.write_bytes(MAGIC + record(1, text("") + text("attacker")) + b"".join(chunks))
    return path


@pytest.mark.parametrize("claimed", [0, 100, 3 * 2**30, 2**63])
@pytest.mark.parametrize("compression", ["zstd", "lz4"])
def test_chunk_that_unpacks_to_gigabytes_is_refused_within_bounds(
    tmp_path: Path, compression: str, claimed: int
) -> None:
    # lz4 packs 255 to 1 at best; zstd makes 3 GB of less than 300 kB.
    packed = bomb(compression, 256 * 2**20)
    path = mcap_file(tmp_path / "bomb.mcap", chunk(compression, packed, claimed))
    tracemalloc.start()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(ValidationError, match="unpacks to more than"):
        list(read_items(path))
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    tracemalloc.stop()
    assert grown < 4 * recording_file.CHUNK_MAX_BYTES / 1024


def test_many_small_chunks_that_unpack_to_gigabytes_are_refused(tmp_path: Path) -> None:
    each = chunk("zstd", bomb("zstd", 32 * 2**20), 32 * 2**20)
    path = mcap_file(tmp_path / "bombs.mcap", *[each] * 100)
    assert path.stat().st_size < 500_000
    with pytest.raises(ValidationError, match="unpacks to more than"):
        recorded_actions(path)


def recording(path: Path, schema: str, encoding: str, messages: list[bytes]) -> Path:
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        made = writer.register_schema(schema, "x", b"{}")
        channel = writer.register_channel("/arm-1/streamStep", encoding, made)
        for at, data in enumerate(messages):
            writer.add_message(channel, at, data, at)
        writer.finish()
    return path


MESSAGES = {
    "an event of empty lists": ("event", "json", b"[" + b"[]," * 300_000 + b"[]]"),
    "an event that is no object": ("event", "json", b"[1]"),
    "an event of megabytes": ("event", "json", b'{"action": "' + b"x" * 2**21 + b'"}'),
    "the deepest event": ("event", "json", b"[" * 100_000),
    "a million joints": (
        schemas.JOINT_STATE.name,
        "cdr",
        b"\0\1\0\0" + bytes(12) + struct.pack("<I", 10**6) + bytes(4 * 10**6),
    ),
}


@pytest.mark.parametrize("what", MESSAGES)
def test_message_that_would_take_the_memory_is_refused(tmp_path: Path, what: str) -> None:
    schema, encoding, data = MESSAGES[what]
    path = recording(tmp_path / "bomb.mcap", schema, encoding, [data])
    tracemalloc.start()
    with pytest.raises(ValidationError, match="no recording of robots"):
        recorded_actions(path)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < recording_file.CHUNK_MAX_BYTES + 4 * len(data) + 2**20


def test_number_of_a_megabyte_in_a_picture_ends_at_64_bits(tmp_path: Path) -> None:
    bomb = b"\x80" * 2**20
    began = time.thread_time()
    list(read_items(recording(tmp_path / "bomb.mcap", schemas.IMAGE.name, "protobuf", [bomb])))
    assert time.thread_time() - began < 5.0


def test_chunk_of_many_records_is_never_held_as_objects(tmp_path: Path) -> None:
    packed = zstandard.ZstdCompressor().compress(record(0x03, struct.pack("<H", 1) + text("") * 2 + bytes(4)) * 100_000)
    path = mcap_file(tmp_path / "many.mcap", chunk("zstd", packed, 0))
    tracemalloc.start()
    assert list(read_items(path)) == []
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < recording_file.CHUNK_MAX_BYTES + 8 * 2**20


def test_record_that_claims_gigabytes_is_refused(tmp_path: Path) -> None:
    path = mcap_file(tmp_path / "long.mcap", struct.pack("<BQ", 5, 3 * 2**30))
    with pytest.raises(ValidationError, match="no recording of robots"):
        list(read_items(path))


@pytest.mark.parametrize(("compression", "data"), [("zstd", b"none"), ("lz4", b"no frame of lz4"), ("brotli", b"")])
def test_chunk_that_cannot_be_unpacked_is_refused(tmp_path: Path, compression: str, data: bytes) -> None:
    with pytest.raises(ValidationError, match="chunk"):
        list(read_items(mcap_file(tmp_path / "odd.mcap", chunk(compression, data, 4))))


@pytest.mark.parametrize("packing", list(CompressionType))
def test_recordings_of_every_packing_are_read(tmp_path: Path, packing: CompressionType) -> None:
    path = tmp_path / "run.mcap"
    with path.open("wb") as file:
        writer = Writer(file, compression=packing)
        writer.start()
        schema = writer.register_schema("strands.Event", "jsonschema", b"{}")
        channel = writer.register_channel("/arm-1/streamStep", "json", schema)
        for at in range(3):
            writer.add_message(channel, at * 10**9, b'{"action":{"a.pos":1.0}}', at * 10**9)
        writer.finish()
    assert [at for at, _ in recorded_actions(path)] == [0.0, 1.0, 2.0]
