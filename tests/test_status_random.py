"""Reports in any order, of any request: a call ends once, and as the first word about it says."""

from __future__ import annotations

import asyncio
from typing import Any, Literal

from diagnostic_msgs.msg import DiagnosticStatus
from hypothesis import given, settings
from hypothesis import strategies as st

from rosasync import HandlerFailed, Limits, ServerGone, ServerOverloaded, to_message
from rosasync._core.ports import TopicQos
from rosasync._status.wire import Outcome, Report, process_of, report_topic
from tests.support.echo import ECHO, answer_to, request_of
from tests.support.fake_graph import FakeGraph
from tests.support.serving import Holder, echo_of

CALLS = 4
ERRORS = {
    Outcome.FAILED: HandlerFailed,
    Outcome.DROPPED: ServerOverloaded,
    Outcome.CLOSED: ServerGone,
}
Step = tuple[Literal["answer", "cancel", "report"], int, Outcome, Literal["right", "other"]]

# A report may come before its response or after it, twice, of another server, or not at all.
STEPS = st.lists(
    st.tuples(
        st.sampled_from(["answer", "cancel", "report"]),
        st.integers(0, CALLS - 1),
        st.sampled_from(Outcome),
        st.sampled_from(["right", "other"]),
    ),
    max_size=12,
)


@settings(deadline=None, max_examples=150)
@given(steps=STEPS)
def test_a_call_ends_as_the_first_word_about_it_says(steps: list[Step]) -> None:
    ended = asyncio.run(_play(steps))
    expected: dict[int, Any] = {}
    for kind, call, outcome, server in steps:
        if call in expected or (kind == "report" and server == "other"):
            continue
        expected[call] = ERRORS[outcome] if kind == "report" else kind
    assert ended == [expected.get(call, "answer") for call in range(CALLS)]


async def _play(steps: list[Step]) -> list[Any]:
    graph = FakeGraph()
    holder = Holder()
    limits = Limits(in_flight=CALLS, server_depth=None)
    async with graph.session() as server, graph.session(limits=limits) as client:
        server.serve(ECHO, "/told", holder, status=True)
        tasks = [
            client.start(ECHO, "/told", request_of(str(number)), timeout=None)
            for number in range(CALLS)
        ]
        calls = await holder.held(CALLS)
        pool = client.pool.service(ECHO, "/told", None)
        (right,) = client.core.node.queries.find_servers(pool.service)
        assert isinstance(right, bytes)
        publisher = server.core.node.open_publisher(
            DiagnosticStatus, report_topic(str(process_of(right))), TopicQos()
        )
        for kind, number, outcome, told_by in steps:
            if kind == "answer" and not calls[number].responded:
                calls[number].respond(echo_of(calls[number].request))
            elif kind == "cancel":
                tasks[number].cancel()
            elif kind == "report":
                identity = pool.clients[0].identity
                assert isinstance(identity, bytes)
                # Of the same process, as only such a server is believed at all.
                teller = right if told_by == "right" else right[:12] + b"none"
                report = Report("/told", teller, identity, number + 1, outcome)
                publisher.publish(to_message(DiagnosticStatus, report.to_mapping()))
            for _ in range(10):
                await asyncio.sleep(0)
        for call in calls:
            if not (call.responded or call.settled):
                call.respond(echo_of(call.request))
        results = await asyncio.gather(*tasks, return_exceptions=True)
        statistics = client.pool.statistics()
        assert (statistics.in_flight, statistics.waiting) == (0, 0)
        return [_ending(number, result) for number, result in enumerate(results)]


def _ending(number: int, result: Any) -> Any:
    if isinstance(result, asyncio.CancelledError):
        return "cancel"
    if isinstance(result, Exception):
        return type(result)
    assert answer_to(result) == str(number)
    return "answer"
