"""What is a command, and which answer is a message owed that is none?"""

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from strands_robots.device_connect.backends import jsonrpc

GOOD = {"jsonrpc": "2.0", "id": "1", "method": "getStatus", "params": {}}


def code_for(payload):
    checked = jsonrpc.check(payload if isinstance(payload, bytes) else json.dumps(payload).encode())
    return checked.code if isinstance(checked, jsonrpc.Refusal) else None


@pytest.mark.parametrize("rpc_id", ["1", "", 7, 1.5, None])
def test_command_with_any_id_of_the_specification_is_one(rpc_id):
    checked = jsonrpc.check(json.dumps({**GOOD, "id": rpc_id}).encode())
    assert checked == jsonrpc.RpcRequest("getStatus", rpc_id)


def test_command_needs_no_params_and_no_version():
    assert code_for({"id": 1, "method": "getStatus"}) is None


@pytest.mark.parametrize(
    "payload",
    [b"", b"x", b"{", b"\xff\xfe", b'{"id":' + b"9" * 5_000 + b"}", b'{"id":1,"x":NaN}', b"-Infinity"],
)
def test_malformed_json_is_a_parse_error(payload):
    assert code_for(payload) == -32700


@pytest.mark.parametrize(
    "payload",
    [
        [],
        "hi",
        3,
        None,
        {},
        {"method": "getStatus"},
        {"id": True, "method": "getStatus"},
        {"id": [1], "method": "getStatus"},
        {"id": {}, "method": "getStatus"},
        {"id": 1},
        {"id": 1, "method": 3},
        {"id": 1, "method": ""},
        {"id": 1, "method": "getStatus", "jsonrpc": "1.0"},
        b" " * (jsonrpc.MAX_COMMAND_BYTES + 1),
        b"[" * 10_000,
        {**GOOD, "params": {"deep": json.loads("[" * 100 + "]" * 100)}},
    ],
)
def test_json_that_is_no_request_is_an_invalid_request(payload):
    assert code_for(payload) == -32600


@pytest.mark.parametrize(
    "params",
    [
        None,
        [],
        [1],
        "x",
        3,
        {"self": 1},
        {"function_name": "x"},
        {"_dc_meta": None},
        {"_dc_meta": []},
        {"_dc_meta": {"source_device": {"a": 1}}},
        {"_dc_meta": {"traceparent": 3}},
        {"source_device": ["x"]},
    ],
)
def test_params_that_no_function_takes_are_invalid_params(params):
    assert code_for({**GOOD, "params": params}) == -32602


def test_refusal_carries_the_id_as_soon_as_it_was_read():
    refusal = jsonrpc.check(json.dumps({**GOOD, "id": "call-7", "params": 3}).encode())
    assert json.loads(refusal.encoded())["id"] == "call-7"


def test_many_brackets_side_by_side_are_not_deep():
    assert code_for({**GOOD, "params": {"points": [[0, 0]] * 1_000}}) is None


@given(st.binary(max_size=200))
def test_check_never_raises(data):
    checked = jsonrpc.check(data)
    if isinstance(checked, jsonrpc.Refusal):
        assert json.loads(checked.encoded())["error"]["code"] in (-32700, -32600, -32602)


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(max_size=9),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=9), inner, max_size=4),
    max_leaves=12,
)


@given(st.fixed_dictionaries({}, optional={"id": JSON, "method": JSON, "params": JSON, "jsonrpc": JSON}))
def test_every_object_is_a_command_or_has_a_code(request_):
    checked = jsonrpc.check(json.dumps(request_).encode())
    assert isinstance(checked, jsonrpc.RpcRequest) or checked.code in (-32600, -32602)


@given(JSON)
def test_valid_json_accepts_json(value):
    assert jsonrpc.valid_json(json.dumps(value).encode())


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_valid_json_finds_nan_and_infinity(value):
    assert not jsonrpc.valid_json(json.dumps({"x": [value]}).encode())


def test_valid_json_accepts_nan_in_a_text():
    assert jsonrpc.valid_json(b'{"text": "NaN and Infinity"}')


@pytest.mark.parametrize("method", jsonrpc.STOPS)
@pytest.mark.parametrize(
    "odd",
    [
        {"params": None},
        {"params": ["left"]},
        {"params": {"self": 1}},
        {"params": {"_dc_meta": []}},
        {"params": {"source_device": 5}},
        {"id": True},
        {"id": [1]},
        {"jsonrpc": "1.0"},
    ],
)
def test_stop_is_refused_for_no_other_part_of_its_message(method, odd):
    checked = jsonrpc.check(json.dumps({**GOOD, "method": method, **odd}).encode())
    assert isinstance(checked, jsonrpc.RpcRequest)
    assert checked.method == method
    assert checked.params == {}


def test_stop_without_an_id_is_one():
    checked = jsonrpc.check(b'{"method": "stop", "params": {"robot_name": "left"}}')
    assert (checked.method, checked.id) == ("stop", None)
