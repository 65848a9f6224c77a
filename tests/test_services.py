"""Sending responses to clients that are not matched: when to send, wait or give up."""

from __future__ import annotations

import threading
from types import SimpleNamespace
from typing import Any

import pytest
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.qos import QoSDurabilityPolicy, QoSProfile
from std_srvs.srv import Trigger

from rosasync._core.ports import PortDestroyed, Undeliverable, Unmatched
from rosasync._ros import responder
from rosasync._ros.responder import (
    MATCH_DELAYS,
    MOST_UNREACHED,
    POLL_INTERVAL,
    WATCH_TIME,
    Responder,
    client_of,
)
from rosasync._server.resending import RESEND
from rosasync.errors import ContextShutdown, RosasyncError
from tests.support.times import LIMIT, TICK

BLOCKED = 0.1
"""Seconds for which the middleware waits for a client."""
STEP = 1.2 * max(POLL_INTERVAL, MATCH_DELAYS[0])
VOLATILE = QoSProfile(depth=10)
TRANSIENT = QoSProfile(depth=10, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL)


def guid(process: int, number: int) -> bytes:
    return bytes([process] * 12 + [number] * 4)


GOOD, BAD = guid(1, 4), guid(2, 4)


class Header:
    """The header of a request, which identifies its client if ``known``."""

    def __init__(self, client: bytes, known: bool = True) -> None:
        self.client = client
        self.known = known
        self.request_id: Any = self
        self.sequence_number = 1
        self.source_timestamp = self.received_timestamp = 0


RESPONSE = Trigger.Response()


class Middleware:
    """A node, its only service and the graph, with a clock of their own.

    Attributes:
        now: what ``monotonic`` returns.
        unmatched: the clients to which a send waits and fails.
        report: how a failure is reported: "error", "warning" or "nothing".
        wait: the seconds for which a send waits before it fails.
        sent: the clients that were sent to, in order.
        queries: how often the graph was queried.
    """

    def __init__(self) -> None:
        self.handle = self.context = self
        self.pointer = 1
        self.up = True
        self.service_name = "/served"
        self.srv_type = Trigger
        self.now = 100.0
        self.unmatched: set[bytes] = set()
        self.report = "error"
        self.wait = BLOCKED
        self.sent: list[bytes] = []
        self.queries = 0
        self.readers: dict[bytes, QoSProfile] = {}
        self.writers: list[bytes] = []

    def __enter__(self) -> None:
        """Like a handle in use."""

    def __exit__(self, *_: object) -> None:
        """Like a handle that is no longer in use."""

    def ok(self) -> bool:
        return self.up

    def join(self, client: bytes, qos: QoSProfile = VOLATILE, *, reader: bool = True) -> None:
        """Show a client in the graph: its writer, and its reader."""
        self.writers.append(client[:12] + bytes([client[-1] - 1] * 4))
        if reader:
            self.readers[client] = qos

    def leave(self, client: bytes) -> None:
        """Remove a client from the graph."""
        self.readers.pop(client, None)
        self.writers.remove(client[:12] + bytes([client[-1] - 1] * 4))

    def service_send_response(self, response: object, request_id: Header) -> None:
        client = request_id.client
        self.sent.append(client)
        if client not in self.unmatched:
            return
        self.now += self.wait
        if self.report == "error":
            raise SystemError from RuntimeWarning("client will not receive response")
        if self.report == "warning":
            # The interpreter does this too, independent of the filters.
            responder.__warningregistry__["version"] = 1

    def get_publishers_info_by_topic(self, name: str, no_mangle: bool) -> list[Any]:
        assert (name, no_mangle) == ("rq/servedRequest", True)
        self.queries += 1
        return [SimpleNamespace(endpoint_gid=list(gid)) for gid in self.writers]

    def get_subscriptions_info_by_topic(self, name: str, no_mangle: bool) -> list[Any]:
        assert (name, no_mangle) == ("rr/servedReply", True)
        return [
            SimpleNamespace(endpoint_gid=list(gid), qos_profile=qos)
            for gid, qos in self.readers.items()
        ]


@pytest.fixture
def middleware(monkeypatch: pytest.MonkeyPatch) -> Middleware:
    """A server with one client, which is matched."""
    middleware = Middleware()
    middleware.join(GOOD)
    monkeypatch.setattr(responder, "monotonic", lambda: middleware.now)
    monkeypatch.setattr(
        responder, "client_of", lambda header: header.client if header.known else None
    )
    return middleware


@pytest.fixture
def service(middleware: Middleware) -> Responder:
    return Responder(middleware, middleware, VOLATILE)


def fail(service: Responder, client: bytes, *, known: bool = True) -> str:
    """Send a response that cannot arrive yet, and return the reason."""
    with pytest.raises(Unmatched) as caught:
        service.send(Header(client, known), RESPONSE)
    return str(caught.value)


@pytest.mark.parametrize("report", ["error", "warning", "nothing"])
def test_a_client_that_is_not_discovered_blocks_once(
    middleware: Middleware, service: Responder, report: str
) -> None:
    middleware.report = report
    middleware.unmatched.add(BAD)
    middleware.join(BAD, reader=False)
    fail(service, BAD)
    for _ in range(100):
        assert "not discovered completely" in fail(service, BAD)
        service.send(Header(GOOD), RESPONSE)
        middleware.now += STEP
    assert middleware.sent.count(BAD) == 1
    assert middleware.sent.count(GOOD) == 100


def test_it_gets_its_responses_when_it_has_been_visible_for_a_moment(
    middleware: Middleware, service: Responder
) -> None:
    middleware.unmatched.add(BAD)
    middleware.join(BAD, reader=False)
    fail(service, BAD)
    middleware.now += STEP
    middleware.readers[BAD] = VOLATILE
    assert "just now" in fail(service, BAD)
    middleware.unmatched.clear()
    middleware.now += STEP
    for _ in range(5):
        service.send(Header(BAD), RESPONSE)
    assert middleware.sent == [BAD] * 6


def test_one_that_cannot_be_matched_although_it_is_visible_is_given_up(
    middleware: Middleware, service: Responder
) -> None:
    middleware.unmatched.add(BAD)
    middleware.join(BAD)
    fail(service, BAD)
    for _ in range(int(2 * sum(MATCH_DELAYS) / STEP)):
        middleware.now += STEP
        with pytest.raises(Undeliverable):
            service.send(Header(BAD), RESPONSE)
    assert middleware.sent == [BAD] * (1 + len(MATCH_DELAYS))
    with pytest.raises(Undeliverable, match="does not match it"):
        service.send(Header(BAD), RESPONSE)


def test_one_whose_match_takes_longer_than_a_send_waits_gets_its_response(
    middleware: Middleware, service: Responder
) -> None:
    middleware.unmatched.add(BAD)
    middleware.join(BAD)
    for _ in range(len(MATCH_DELAYS)):
        fail(service, BAD)
        assert "just now" in fail(service, BAD)
        middleware.now += MATCH_DELAYS[-1]
    middleware.unmatched.clear()
    service.send(Header(BAD), RESPONSE)
    assert middleware.sent == [BAD] * (1 + len(MATCH_DELAYS))


@pytest.mark.parametrize("report", ["error", "warning"])
def test_a_qos_that_cannot_match_is_refused_at_once(
    middleware: Middleware, service: Responder, report: str
) -> None:
    middleware.report = report
    middleware.unmatched.add(BAD)
    middleware.join(BAD, TRANSIENT)
    for _ in range(100):
        with pytest.raises(Undeliverable, match="QoS") as caught:
            service.send(Header(BAD), RESPONSE)
        assert not isinstance(caught.value, Unmatched)
        service.send(Header(GOOD), RESPONSE)
        middleware.now += 1.0
    assert middleware.sent.count(BAD) == 1
    assert middleware.sent.count(GOOD) == 100


def test_others_that_join_meanwhile_do_not_block_at_all(
    middleware: Middleware, service: Responder
) -> None:
    middleware.unmatched.add(BAD)
    middleware.join(BAD, reader=False)
    fail(service, BAD)
    others = [guid(process, 4) for process in range(10, 20)]
    for other in others:
        middleware.join(other, reader=False)
    middleware.now += STEP
    for other in others:
        assert "not discovered" in fail(service, other)
        middleware.readers[other] = VOLATILE
    middleware.now += STEP
    for other in others:
        service.send(Header(other), RESPONSE)
    assert middleware.sent == [BAD, *others]


def test_a_slow_send_to_a_visible_client_has_sent(
    middleware: Middleware, service: Responder
) -> None:
    """A send may be slow because the machine is busy, although nothing was reported."""
    middleware.report = "nothing"
    middleware.unmatched.add(GOOD)
    for _ in range(3):
        service.send(Header(GOOD), RESPONSE)
    assert middleware.sent == [GOOD] * 3


def test_a_send_that_fails_without_waiting_has_failed(
    middleware: Middleware, service: Responder
) -> None:
    """A profile may set the time for which the middleware waits."""
    middleware.report = "warning"
    middleware.unmatched.add(GOOD)
    middleware.wait = 0.0
    assert "not matched" in fail(service, GOOD)


def test_a_failed_send_is_not_taken_for_that_of_another_thread(
    middleware: Middleware, monkeypatch: pytest.MonkeyPatch
) -> None:
    """rclpy's warning does not say which send has failed."""
    middleware.join(BAD)
    begun, failed = threading.Event(), threading.Event()

    def begin(self: Middleware) -> None:
        if threading.current_thread() is other:
            begun.set()
            assert failed.wait(LIMIT)

    def send(response: object, request_id: Header) -> None:
        if request_id.client == BAD:
            other.start()
            begun.wait(TICK)
            responder.__warningregistry__["version"] = 1
            middleware.now += BLOCKED
            failed.set()
            # The other thread ends now, if it was let in.
            other.join(TICK)
        middleware.sent.append(request_id.client)

    monkeypatch.setattr(Middleware, "__enter__", begin)
    monkeypatch.setattr(middleware, "service_send_response", send)
    service = Responder(middleware, middleware, VOLATILE)
    errors: list[Exception] = []

    def send_good() -> None:
        try:
            service.send(Header(GOOD), RESPONSE)
        except Exception as error:
            errors.append(error)

    other = threading.Thread(target=send_good)
    fail(service, BAD)
    other.join(LIMIT)
    assert errors == []
    assert middleware.sent == [BAD, GOOD]


def test_clients_that_left_are_forgotten(middleware: Middleware, service: Responder) -> None:
    for number in range(5):
        bad = guid(10 + number, 4)
        middleware.unmatched = {bad}
        middleware.join(bad, reader=False)
        fail(service, bad)
        middleware.leave(bad)
        middleware.now += WATCH_TIME
        middleware.unmatched.clear()
        service.send(Header(bad), RESPONSE)
        assert not service._unreached
    middleware.now += WATCH_TIME
    before = middleware.queries
    for _ in range(10):
        middleware.now += WATCH_TIME
        service.send(Header(GOOD), RESPONSE)
    assert middleware.queries == before


def test_few_clients_are_remembered(
    middleware: Middleware, service: Responder, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(responder, "MOST_UNREACHED", 3)
    assert MOST_UNREACHED > 100
    for number in range(10):
        bad = guid(10 + number, 4)
        middleware.unmatched.add(bad)
        middleware.join(bad, TRANSIENT)
        middleware.now += 2 * WATCH_TIME
        with pytest.raises(Undeliverable):
            service.send(Header(bad), RESPONSE)
    assert len(service._unreached) == 3


def test_without_an_identity_one_attempt_in_a_while_may_block(
    middleware: Middleware, service: Responder
) -> None:
    middleware.unmatched.add(BAD)
    middleware.join(BAD, reader=False)
    fail(service, BAD, known=False)
    while middleware.now < 100.0 + WATCH_TIME:
        fail(service, BAD, known=False)
        fail(service, GOOD, known=False)
        middleware.now += STEP
    assert middleware.sent == [BAD]
    middleware.readers[BAD] = VOLATILE
    middleware.unmatched.clear()
    middleware.now += STEP
    service.send(Header(BAD, known=False), RESPONSE)
    service.send(Header(GOOD, known=False), RESPONSE)


def test_without_an_identity_a_qos_that_cannot_match_blocks_once_in_a_while(
    middleware: Middleware, service: Responder
) -> None:
    middleware.unmatched.add(BAD)
    middleware.join(BAD, TRANSIENT)
    fail(service, BAD, known=False)
    while middleware.now < 100.0 + WATCH_TIME:
        assert "not matched" in fail(service, BAD, known=False)
        middleware.now += STEP
    assert middleware.sent == [BAD]


def test_the_graph_is_queried_only_after_a_slow_send(
    middleware: Middleware, service: Responder
) -> None:
    for _ in range(10):
        service.send(Header(GOOD), RESPONSE)
    assert middleware.queries == 0
    middleware.unmatched.add(BAD)
    middleware.join(BAD, reader=False)
    fail(service, BAD)
    before = middleware.queries
    for _ in range(100):
        fail(service, BAD)
    assert middleware.queries == before


def test_a_graph_that_names_topics_otherwise_holds_nothing_back(
    middleware: Middleware, service: Responder
) -> None:
    middleware.readers.clear()
    middleware.writers.clear()
    middleware.unmatched.add(GOOD)
    fail(service, GOOD)
    middleware.unmatched.clear()
    middleware.now += STEP
    service.send(Header(GOOD), RESPONSE)
    assert middleware.sent == [GOOD, GOOD]


def test_other_errors_of_the_interpreter_pass(
    middleware: Middleware, monkeypatch: pytest.MonkeyPatch
) -> None:
    def failing(response: object, request_id: object) -> None:
        raise SystemError("another one")

    monkeypatch.setattr(middleware, "service_send_response", failing)
    with pytest.raises(SystemError, match="another one"):
        Responder(middleware, middleware, VOLATILE).send(Header(GOOD), RESPONSE)


def test_what_rcl_refuses_is_named(middleware: Middleware, monkeypatch: pytest.MonkeyPatch) -> None:
    def failing(response: object, request_id: object) -> None:
        raise rclpy_implementation.RCLError("refused")

    monkeypatch.setattr(middleware, "service_send_response", failing)
    service = Responder(middleware, middleware, VOLATILE)
    with pytest.raises(RosasyncError, match="refuses the response: refused"):
        service.send(Header(GOOD), RESPONSE)
    middleware.pointer = 0
    with pytest.raises(ContextShutdown):
        service.send(Header(GOOD), RESPONSE)
    service._node = Middleware()
    with pytest.raises(PortDestroyed):
        service.send(Header(GOOD), RESPONSE)


def test_a_server_tries_for_longer_than_it_watches() -> None:
    assert sum(RESEND) > WATCH_TIME


def test_what_is_no_header_of_rclpy_has_no_identity() -> None:
    class rmw_service_info_t:
        __slots__ = ()

    for header in (Header(GOOD), rmw_service_info_t(), object()):
        assert client_of(header) is None  # type: ignore[arg-type]
