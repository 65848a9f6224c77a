"""Sending responses: what happens where the client is not quite discovered."""

from __future__ import annotations

from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import pytest

from rosasync.ports import Unmatched
from rosasync.ros import services
from rosasync.ros.services import Responder
from rosasync.service_call import RESEND
from tests.support.echo import ECHO
from tests.support.serving import FORMS
from tests.support.times import TICK, until

if TYPE_CHECKING:
    from rosasync import Session
    from tests.support.clients import ClientProcess


class Middleware:
    """A service whose next sends are in vain, and a graph that shows what it is told to."""

    def __init__(self) -> None:
        self.name = "/served"
        self.handle = self
        self.in_vain = 0
        self.sent = 0
        self.endpoints: dict[str, list[bytes]] = {"rq/servedRequest": [], "rr/servedReply": []}

    def service_send_response(self, response: object, request_id: object) -> None:
        """As rclpy does under `warnings.filterwarnings("error")`."""
        self.sent += 1
        if self.in_vain:
            self.in_vain -= 1
            raise SystemError from RuntimeWarning("client will not receive response")

    def get_publishers_info_by_topic(self, name: str, no_mangle: bool) -> list[Any]:
        assert no_mangle
        return [SimpleNamespace(endpoint_gid=list(gid)) for gid in self.endpoints[name]]

    get_subscriptions_info_by_topic = get_publishers_info_by_topic


def endpoint(process: int, number: int) -> bytes:
    return bytes([process] * 12 + [number] * 4)


@pytest.fixture
def middleware() -> Middleware:
    """A server with a client, wholly discovered."""
    middleware = Middleware()
    middleware.endpoints["rq/servedRequest"].append(endpoint(1, 1))
    middleware.endpoints["rr/servedReply"].append(endpoint(1, 2))
    return middleware


@pytest.fixture
def responder(middleware: Middleware, monkeypatch: pytest.MonkeyPatch) -> Responder:
    monkeypatch.setattr(services, "LOOK", 0.0)
    middleware.in_vain = 1
    responder = Responder(middleware, middleware)
    with pytest.raises(Unmatched, match="will not receive"):
        responder.send("response", "id")
    assert middleware.sent == 1
    return responder


def test_after_a_send_in_vain_none_is_tried_while_a_client_is_half_known(
    middleware: Middleware, responder: Responder
) -> None:
    middleware.endpoints["rq/servedRequest"].append(endpoint(2, 1))
    for _ in range(100):
        with pytest.raises(Unmatched, match="not quite discovered"):
            responder.send("response", "id")
    assert middleware.sent == 1
    middleware.endpoints["rr/servedReply"].append(endpoint(2, 2))
    responder.send("response", "id")
    assert middleware.sent == 2


def test_readers_of_one_process_do_not_hide_that_another_has_none(
    middleware: Middleware, responder: Responder
) -> None:
    middleware.endpoints["rq/servedRequest"].append(endpoint(2, 1))
    middleware.endpoints["rr/servedReply"].append(endpoint(3, 1))
    with pytest.raises(Unmatched):
        responder.send("response", "id")
    assert middleware.sent == 1


def test_a_reader_more_is_no_reason_to_wait(middleware: Middleware, responder: Responder) -> None:
    middleware.endpoints["rr/servedReply"].append(endpoint(2, 2))
    responder.send("response", "id")
    assert middleware.sent == 2


def test_a_writer_that_never_gets_a_reader_is_waited_for_only_so_long(
    middleware: Middleware, responder: Responder, monkeypatch: pytest.MonkeyPatch
) -> None:
    middleware.endpoints["rq/servedRequest"].append(endpoint(2, 1))
    monkeypatch.setattr(services, "monotonic", lambda: responder._wary_until + 1)
    responder.send("response", "id")
    assert middleware.sent == 2


def test_without_a_send_in_vain_the_graph_is_not_asked(middleware: Middleware) -> None:
    middleware.endpoints.clear()
    Responder(middleware, middleware).send("response", "id")
    assert middleware.sent == 1


def test_wary_for_less_time_than_a_server_tries() -> None:
    assert sum(RESEND) > services.WARY


async def test_the_graph_shows_both_ends_of_real_clients(
    session: Session, client_process: ClientProcess
) -> None:
    """Under the names that are looked for, and with as many of each in a process."""
    session.serve(ECHO, "/served", FORMS["plain, call"])
    await client_process.start("/served", None, clients=3, timeout=TICK)
    await session.pool.warm(ECHO, "/served")

    def shown(topic: str, kind: str) -> Any:
        find = getattr(session.node, f"get_{kind}_info_by_topic")
        return services._by_process(find(topic, no_mangle=True))

    def counts() -> tuple[Any, Any]:
        return shown("rq/servedRequest", "publishers"), shown("rr/servedReply", "subscriptions")

    await until(lambda: sorted(counts()[0].values()) == [1, 3])
    await until(lambda: counts()[0] == counts()[1])
    await client_process.result()
    await until(lambda: list(counts()[0].values()) == [1])
