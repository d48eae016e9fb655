"""The members of nats-py that ours replaces are those that were read."""

import hashlib
import inspect

import pytest
from nats.aio.client import Client
from nats.aio.transport import TcpTransport
from nats.protocol.parser import Parser

SOURCE_HASHES = {
    Client._process_connect_init: "e1ed2da075c82ab0",
    Client._connect_command: "1999c01f55c91ecc",
    Client._process_op_err: "d4257cb1203cdbcb",
    Client._read_loop: "b44b9401f436dd0e",
    Parser.parse: "7d6165f1766cccd1",
    Parser.reset: "0f304f3f8691385f",
    TcpTransport.connect_tls: "6688ffffefa25d6b",
}


@pytest.mark.parametrize("member", SOURCE_HASHES, ids=lambda member: member.__qualname__)
def test_member_of_nats_py_has_not_changed(member):
    found = hashlib.sha256(inspect.getsource(member).encode()).hexdigest()[:16]
    assert found == SOURCE_HASHES[member], f"read {member.__qualname__} again before trusting backends/_compat.py"
