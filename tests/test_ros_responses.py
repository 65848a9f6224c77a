"""Responses on the real middleware: to clients that can receive them, and to those that cannot."""

from __future__ import annotations

import asyncio
import subprocess
import sys
import warnings
from collections import Counter
from collections.abc import AsyncIterator
from typing import Any

import pytest
from rclpy.qos import QoSDurabilityPolicy, QoSProfile

from rosasync._core.ports import Undeliverable, Unmatched
from rosasync._ros.endpoints import gid_of, response_readers
from rosasync._ros.responder import MATCH_DELAYS, client_of
from tests.conftest import Bridge
from tests.support.echo import ECHO, request_of, service_class
from tests.support.nodes import Opened, borrowed_node, open_node, reports
from tests.support.process import ROOT, own
from tests.support.serving import echo_of
from tests.support.times import LIMIT, until

TRANSIENT = QoSProfile(depth=10, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL)


@pytest.fixture
async def opened(bridge: Bridge) -> AsyncIterator[Opened]:
    async with open_node(bridge) as opened:
        yield opened


async def request(opened: Opened, client: Any, text: str) -> Any:
    """Send a request by a stock client of this process, and return the header that arrives."""
    count = len(opened.requests)
    client.call_async(request_of(text))
    await until(lambda: len(opened.requests) > count)
    return opened.requests[-1][1]


def readers(opened: Opened) -> set[bytes]:
    return {gid_of(reader) for reader in response_readers(opened.ros.node, "/echo")}


async def matched(client: Any, opened: Opened, count: int) -> None:
    """Wait until the graph shows ``count`` clients, and the server is matched with this one."""
    await until(lambda: len(readers(opened)) == count)
    await until(client.service_is_ready)


async def test_a_header_tells_its_client(opened: Opened) -> None:
    """The header has the GUID that the graph shows for the client's response reader."""
    opened.serve()
    with borrowed_node() as node:
        guids: list[bytes | None] = []
        for count in (1, 2, 3):
            known = readers(opened)
            client = node.create_client(service_class(ECHO), "/echo")
            await matched(client, opened, count)
            guids.append(client_of(await request(opened, client, str(count))))
            assert guids[-1] in readers(opened) - known
        assert len(set(guids)) == 3


@pytest.mark.parametrize("action", ["ignore", "default", "always", "error"])
async def test_a_dropped_response_is_noticed_under_every_warning_filter(
    opened: Opened, action: Any
) -> None:
    port = opened.serve()
    with borrowed_node() as node:
        good = node.create_client(service_class(ECHO), "/echo")
        bad = node.create_client(service_class(ECHO), "/echo", qos_profile=TRANSIENT)
        await matched(good, opened, 2)
        with warnings.catch_warnings(record=True):
            warnings.simplefilter(action)
            filters = list(warnings.filters)
            header = await request(opened, bad, "bad")
            for _ in range(3):
                with pytest.raises(Undeliverable, match="QoS") as caught:
                    port.send(header, echo_of(request_of("bad")))
                assert not isinstance(caught.value, Unmatched)
            header = await request(opened, good, "good")
            port.send(header, echo_of(request_of("good")))
            assert warnings.filters == filters


QUIET = """
import asyncio
import rclpy
import rosasync
from rclpy.qos import QoSDurabilityPolicy, QoSProfile
from rclpy.signals import SignalHandlerOptions
from tests.support.echo import ECHO, request_of, service_class
from tests.support.serving import echo_call

async def main():
    async with rosasync.Session("quiet") as session:
        server = session.serve(ECHO, "/quiet", echo_call)
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        node = rclpy.create_node("stock")
        transient = QoSProfile(depth=10, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL)
        client = node.create_client(service_class(ECHO), "/quiet", qos_profile=transient)
        # It never becomes ready, because it cannot receive a response.
        while not server.statistics().undeliverable:
            client.call_async(request_of("text"))
            await asyncio.sleep(0.05)
        print("refused")
        rclpy.shutdown()

asyncio.run(main())
"""


async def test_the_warning_of_rclpy_is_not_on_stderr() -> None:
    """It says that the client will not get a response that is sent again."""
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-W", "default", "-c", QUIET),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        cwd=ROOT,
    )
    async with asyncio.timeout(4 * LIMIT):
        output, errors = await process.communicate()
    assert b"refused" in output
    assert b"RuntimeWarning" not in errors
    assert b"cannot be delivered" in errors


CLIENTS = """
import sys, threading, time
import rclpy
from rclpy.qos import QoSDurabilityPolicy, QoSProfile
from tests.support.echo import ECHO, answer_to, request_of, service_class

rclpy.init()
node = rclpy.create_node("stock")
transient = QoSProfile(depth=10, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL)
bad = node.create_client(service_class(ECHO), "/echo", qos_profile=transient)
good = node.create_client(service_class(ECHO), "/echo")
node.create_timer(0.1, lambda: bad.call_async(request_of("bad")))
assert good.wait_for_service(20.0)
answered = 0
for number in range(40):
    future = good.call_async(request_of(f"good {number}"))
    end = time.monotonic() + 20.0
    while not future.done() and time.monotonic() < end:
        rclpy.spin_once(node, timeout_sec=1.0)
    answered += future.done() and answer_to(future.result()) == f"good {number}"
    pause = time.monotonic() + 0.05
    while time.monotonic() < pause:
        rclpy.spin_once(node, timeout_sec=0.05)
print(answered, flush=True)
node.destroy_node()
rclpy.shutdown()
"""


async def test_a_client_that_never_matches_does_not_stop_the_others(opened: Opened) -> None:
    """The client sends ten requests a second. Each response could block the process for 0.1 s."""
    port = opened.serve()
    sends: Counter[str] = Counter()
    responder = port._responder  # type: ignore[attr-defined]
    send = responder._send

    def counting(response: Any, request_id: Any) -> None:
        sends[response.message.split()[0]] += 1
        send(response, request_id)

    responder._send = counting
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-c", CLIENTS), stdout=subprocess.PIPE, cwd=ROOT
    )
    assert process.stdout is not None
    output = asyncio.create_task(process.stdout.read())
    refused = 0
    loop = asyncio.get_running_loop()

    def answer(asked: Any, header: Any) -> None:
        nonlocal refused
        try:
            port.send(header, echo_of(asked))
        except Unmatched:
            loop.call_later(0.1, answer, asked, header)
        except Undeliverable:
            refused += 1

    async with asyncio.timeout(4 * LIMIT):
        while not output.done():
            while opened.requests:
                answer(*opened.requests.pop(0))
            await asyncio.sleep(0.005)
    assert await process.wait() == 0
    # The middleware logs its errors there too.
    assert own((await output).decode()).splitlines()[-1] == "40"
    # More if the first request comes before its client is discovered completely.
    assert sends["good"] >= 40
    # Further ones, at growing intervals, while it is not discovered completely.
    assert sends["bad"] <= 1 + len(MATCH_DELAYS)
    assert refused > 5


async def test_a_deliver_that_raises_stops_neither_requests_nor_responses(
    opened: Opened, echo: str
) -> None:
    """Each failure is reported to the loop's exception handler."""

    def failing(*_: Any) -> None:
        raise ZeroDivisionError("in deliver")

    client = opened.client(echo)
    await until(client.ready)
    with reports() as reported:
        bad = opened.client(echo, deliver=failing)
        await until(bad.ready)
        for number in range(5):
            bad.send(request_of(str(number)))
            client.send(request_of(str(number)))
        await until(lambda: len(opened.responses) == 5 and len(reported) == 5)
        assert set(reported.errors) == {"in deliver"}
        port = opened.serve("/failing", deliver=failing)
        caller = opened.client("/failing")
        await until(caller.ready)
        for number in range(5):
            caller.send(request_of(str(number)))
        await until(lambda: len(reported) == 10)
        port.close()
    # On the direct bridge a wrong count would leave a response behind.
    client.send(request_of("last"))
    await until(lambda: len(opened.responses) == 6)
