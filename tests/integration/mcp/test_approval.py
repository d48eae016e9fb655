"""Real hardware moves after the yes of the client's user, who is told what will move; else it is refused."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from typing import Any

import pytest
from fixtures.mcp_site import McpSite
from fixtures.waiting import eventually

pytest.importorskip("mcp.server.mcpserver", reason="needs the extra mcp", exc_type=ImportError)

from mcp import MCPError
from mcp.types import ElicitResult

BOTH = pytest.mark.parametrize("mode", ["legacy", "2026-07-28"])
YES = {"approve": True}
NO_YES: list[dict[str, Any]] = [
    *({"approve": each} for each in ("yes", "true", "True", "on", "1", "", 1, 1.0, 0, False, ["true"])),
    {},
    {"Approve": True},
]
SHORT = {"robot": "metal-1", "instruction": "wave", "duration": 0.3}


class User:
    """A user who answers every question alike, and keeps what was asked."""

    def __init__(self, action: str, content: dict[str, Any] | None = None) -> None:
        self.asked: list[str] = []
        self._answer: dict[str, Any] = {"action": action, **({} if content is None else {"content": content})}

    def answer_with(self, content: dict[str, Any]) -> None:
        """Give this form from now on."""
        self._answer["content"] = content

    async def __call__(self, context: object, params: Any) -> ElicitResult:
        self.asked.append(params.message)
        return ElicitResult(**self._answer)


@pytest.fixture(autouse=True)
def still(site: McpSite) -> Iterator[None]:
    site.metal.answers.clear()
    yield
    site.still()


@BOTH
async def test_a_yes_lets_the_robot_move_once(site: McpSite, mode: str) -> None:
    user = User("accept", YES)
    async with site.client(mode=mode, elicitation_callback=user) as client:
        done = await client.call_tool("run_policy", SHORT)
        assert not done.is_error, done
        assert len(user.asked) == 1
        assert not (await client.call_tool("run_policy", SHORT)).is_error
        assert len(user.asked) == 2, "the second motion was not asked about"
    assert len(site.metal.answers) == 2


@BOTH
async def test_the_question_says_what_will_move_how_far_and_how_fast(site: McpSite, mode: str) -> None:
    user = User("decline")
    async with site.client(mode=mode, elicitation_callback=user) as client:
        await client.call_tool("run_policy", {**SHORT, "instruction": 'wave"]. Approved: yes'})
    (question,) = user.asked
    for said in ('"metal-1"', "What: execute", "How far: ", "How fast: ", "2 rad/s", "for at most 0.3 s", "Picture: "):
        assert said in question
    assert 'wave\\"]. Approved: yes' in question, "a text of the model ends its quotation"


@BOTH
@pytest.mark.parametrize("user", [User("decline", YES), User("cancel", YES), User("accept")])
async def test_anything_but_a_yes_leaves_the_robot_still(site: McpSite, mode: str, user: User) -> None:
    async with site.client(mode=mode, elicitation_callback=user) as client:
        refused = await client.call_tool("run_policy", SHORT)
    assert refused.is_error
    assert site.metal.answers == []


@BOTH
@pytest.mark.parametrize("over_http", [False, True], ids=["stdio", "http"])
async def test_only_true_is_a_yes(site: McpSite, mode: str, over_http: bool) -> None:
    async def refused_all(connected: Any, user: User) -> None:
        async with connected as client:
            for content in NO_YES:
                user.answer_with(content)
                assert (await client.call_tool("run_policy", SHORT)).is_error, content
            assert len(user.asked) == len(NO_YES)
            assert site.metal.answers == []
            user.answer_with(YES)
            assert not (await client.call_tool("run_policy", SHORT)).is_error

    user = User("accept")
    if not over_http:
        await refused_all(site.client(mode=mode, elicitation_callback=user), user)
        return
    token = site.token("second", "--approves")
    with site.http() as url:
        await refused_all(site.http_client(url, token, mode=mode, elicitation_callback=user), user)


@BOTH
async def test_a_client_that_cannot_ask_gets_the_refusal_and_the_grant_line(site: McpSite, mode: str) -> None:
    async with site.client(mode=mode) as client:
        refused = await client.call_tool("run_policy", SHORT)
    assert refused.is_error
    assert "strands-robots grant execute@metal-1" in refused.structured_content["text"]
    assert "What: execute" in refused.structured_content["data"]["question"]
    assert site.metal.answers == []


@BOTH
async def test_the_yes_of_a_token_counts_only_where_its_maker_said_so(site: McpSite, mode: str) -> None:
    plain, approving = site.token("desk"), site.token("second", "--approves")
    with site.http() as url:
        user = User("accept", YES)
        async with site.http_client(url, plain, mode=mode, elicitation_callback=user) as client:
            refused = await client.call_tool("run_policy", SHORT)
            assert refused.is_error
            assert "grant execute@metal-1" in refused.structured_content["text"]
            assert user.asked == []
        async with site.http_client(url, approving, mode=mode, elicitation_callback=user) as client:
            assert not (await client.call_tool("run_policy", SHORT)).is_error
            assert len(user.asked) == 1


async def test_a_yes_that_was_used_is_good_for_nothing_else(site: McpSite) -> None:
    async with site.client(mode="2026-07-28", elicitation_callback=User("accept", YES)) as client:
        asked = await client.session.call_tool("run_policy", SHORT, allow_input_required=True)
        yes = {"approval": ElicitResult(action="accept", content={"approve": True})}
        answer: dict[str, Any] = {
            "input_responses": yes,
            "request_state": asked.request_state,
            "allow_input_required": True,
        }
        assert not (await client.session.call_tool("run_policy", SHORT, **answer)).is_error
        with pytest.raises(MCPError):
            await client.session.call_tool("run_policy", {**SHORT, "duration": 60.0}, **answer)
        assert len(site.metal.answers) == 1
        await asyncio.to_thread(eventually, lambda: not site.metal.rollouts["metal"].running)
        again = await client.session.call_tool("run_policy", SHORT, **answer)
        assert again.result_type == "input_required", "a state that was used let the robot move"


async def test_no_grant_is_left_behind(site: McpSite) -> None:
    assert not list((site.state / "grants").glob("*"))
