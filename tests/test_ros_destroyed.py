"""Parts that are destroyed or shut down under a session: each has exactly one error."""

from __future__ import annotations

import asyncio
import errno
import os
import subprocess
import sys
import threading
from collections.abc import Callable
from typing import Any

import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions
from std_srvs.srv import SetBool

from rosasync import Session
from rosasync._core.ports import PortDestroyed
from rosasync._ros import signals
from rosasync._ros.rcl import Rcl
from rosasync.errors import ContextShutdown, InvalidServiceName, RosasyncError, UsageError
from tests.conftest import Bridge
from tests.support.checks import count_descriptors, count_threads
from tests.support.echo import ECHO, request_of
from tests.support.nodes import borrowed_node, open_node, reports
from tests.support.process import ROOT
from tests.support.serving import echo_of
from tests.support.times import LIMIT, until

TRIGGER = "std_srvs/srv/Trigger"

Ending = Callable[[Any], object]


def destroy_node(node: Any) -> None:
    node.destroy_node()


def shut_down(node: Any) -> None:
    node.context.shutdown()


ENDINGS = [destroy_node, shut_down]


@pytest.mark.parametrize("end", ENDINGS)
async def test_a_node_that_is_down(bridge: Bridge, end: Ending) -> None:
    with reports() as reported, borrowed_node() as node:
        async with open_node(bridge, node) as opened:
            ros = opened.ros
            service = opened.service()
            port = opened.serve()
            client = opened.client()
            await until(client.ready)
            number = client.send(request_of("before"))
            await until(lambda: opened.requests)
            request, header = opened.requests[0]
            end(node)
            assert not ros.ok()
            assert ros.name == "lender"
            await until(lambda: refuses(client.send, request_of("after")))
            uses: list[Callable[[], object]] = [
                lambda: ros.describe(ECHO, "/echo", None),
                lambda: ros.queries.find_servers(service),
                lambda: ros.queries.explain_missing(service),
                lambda: opened.ros.open_client(service, lambda *_: None),
                lambda: opened.ros.open_service(service, lambda *_: None),
                lambda: client.send(request_of("after")),
                client.ready,
                port.has_clients,
            ]
            if port.destroyed:
                uses.append(lambda: port.send(header, echo_of(request)))
            for use in uses:
                with pytest.raises(ContextShutdown, match="context was shut down, or the node"):
                    use()
            client.forget(number)
            port.stop()
            for entity in (client, port):
                entity.close()
                entity.close()
    assert reported == []


def refuses(function: Callable[..., object], *args: Any) -> bool:
    """Return whether it raises `ContextShutdown`, which it may only do in the next turn."""
    try:
        function(*args)
    except ContextShutdown:
        return True
    return False


async def test_a_client_that_the_program_destroys(bridge: Bridge, echo: str) -> None:
    with reports() as reported:
        async with open_node(bridge) as opened:
            client, other = opened.client(echo), opened.client(echo)
            await until(lambda: client.ready() and other.ready())
            number = client.send(request_of("out"))
            for destroyed in tuple(opened.ros.node.clients):
                if destroyed.handle is client.handle:  # type: ignore[attr-defined]
                    opened.ros.node.destroy_client(destroyed)
            with pytest.raises(PortDestroyed):
                client.send(request_of("x"))
            with pytest.raises(PortDestroyed):
                client.ready()
            other.send(request_of("other"))
            await until(lambda: [text for _, text in opened.responses][-1:] == ["other"])
            client.forget(number)
            client.close()
            client.close()
            other.send(request_of("again"))
            await until(lambda: [text for _, text in opened.responses][-1:] == ["again"])
    assert reported == []


async def test_a_service_that_is_destroyed_as_soon_as_it_is_created(
    bridge: Bridge, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As by a thread that shuts the context down, on Kilted: rclpy crashes if its QoS is read."""
    with borrowed_node() as node:
        async with open_node(bridge, node) as opened:
            create = node.create_service

            def create_and_destroy(*args: Any, **options: Any) -> Any:
                service = create(*args, **options)
                node.destroy_service(service)
                return service

            monkeypatch.setattr(node, "create_service", create_and_destroy)
            with pytest.raises(RosasyncError, match="destruction was requested"):
                opened.serve()


async def test_a_service_that_the_program_destroys(bridge: Bridge) -> None:
    with reports() as reported:
        async with open_node(bridge) as opened:
            port, other = opened.serve("/held"), opened.serve("/other")
            client, caller = opened.client("/held"), opened.client("/other")
            await until(lambda: client.ready() and caller.ready())
            client.send(request_of("x"))
            await until(lambda: opened.requests)
            assert not port.destroyed
            opened.ros.node.destroy_service(port.handle)
            assert port.destroyed
            assert not other.destroyed
            request, header = opened.requests[0]
            with pytest.raises(PortDestroyed):
                port.send(header, echo_of(request))
            port.has_clients()
            port.stop()
            port.close()
            assert not port.destroyed
            caller.send(request_of("y"))
            await until(lambda: len(opened.requests) == 2)
            opened.answer(other, 1)
            await until(lambda: opened.responses)
    assert reported == []


@pytest.mark.parametrize("kind", ["client", "service"])
def test_what_is_destroyed_while_its_signal_is_set(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By another thread, which a call into librcl lets run."""
    rcl = Rcl()
    name, signal = {
        "client": ("_on_response", rcl.signal_responses),
        "service": ("_on_request", rcl.signal_requests),
    }[kind]
    function = getattr(rcl, name)
    valid: list[bool] = []

    def interrupted(pointer: int, *arguments: Any) -> int:
        getattr(node, f"destroy_{kind}")(entity)
        valid.append(entity.handle.pointer == pointer)
        return int(function(pointer, *arguments))

    monkeypatch.setattr(rcl, name, interrupted)
    descriptor = os.eventfd(0)
    with borrowed_node() as node:
        callback = [] if kind == "client" else [lambda _, response: response]
        entity = getattr(node, f"create_{kind}")(SetBool, "/interrupted", *callback)
        signal(entity.handle, descriptor)
        assert valid == [True, True]
        assert not signal(entity.handle, descriptor)
        assert not signal(entity.handle, None)
    os.close(descriptor)
    assert valid == [True, True]


async def test_an_executor_that_the_program_shuts_down(bridge: Bridge) -> None:
    with reports() as reported:
        async with open_node(bridge) as opened:
            executor = opened.ros.node.executor
            executor.shutdown()
            await until(lambda: opened.shutdowns)
            assert opened.ros.executor_thread is None
        async with Session("brief", bridge=bridge) as session:
            session.node.executor.shutdown()
    assert reported == []


async def test_a_name_under_two_types(bridge: Bridge) -> None:
    async with open_node(bridge) as opened:
        opened.serve("/name")
        for opening in (opened.client, opened.serve):
            with pytest.raises(
                UsageError, match="another type than std_srvs/srv/Trigger.*use another name"
            ):
                opening("/name", TRIGGER)


async def test_what_else_the_middleware_refuses(
    bridge: Bridge, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refusing(*_: Any, **__: Any) -> Any:
        raise rclpy.impl.implementation_singleton.rclpy_implementation.RCLError("too many")

    async with open_node(bridge) as opened:
        monkeypatch.setattr(opened.ros.node, "create_client", refusing)
        monkeypatch.setattr(opened.ros.node, "create_service", refusing)
        for opening in (opened.client, opened.serve):
            with pytest.raises(RosasyncError, match="/echo: the middleware refused .*too many"):
                opening()
        with pytest.raises(InvalidServiceName, match="not a valid service name"):
            opened.client("/" + 300 * "a")


@pytest.mark.parametrize("name", ["", "with space", "1st", "a/b", 300 * "a"])
async def test_a_node_name_that_is_not_allowed(name: str) -> None:
    before = count_threads()
    with pytest.raises(ValueError, match="is not a valid node name"):
        async with Session(name):
            pass
    await until(lambda: count_threads() <= before)


async def test_a_node_that_is_down_already(bridge: Bridge) -> None:
    for end in ENDINGS:
        with borrowed_node() as node:
            end(node)
            with pytest.raises(ContextShutdown):
                async with open_node(bridge, node):
                    pass


FULL = """
import asyncio, contextlib, gc, os, resource, sys
from rosasync.errors import RosasyncError
from tests.support.checks import count_descriptors
from tests.support.nodes import open_node

def fill(spare):
    taken = []
    with contextlib.suppress(OSError):
        while True:
            taken.append(os.open(os.devnull, os.O_RDONLY))
    for _ in range(spare):
        os.close(taken.pop())
    return taken

async def main(bridge):
    for _ in range(2):
        async with open_node(bridge):
            pass
    hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (200, hard))
    before = count_descriptors()
    outcomes = []
    for spare in (0, 1, 2, 30):
        taken = fill(spare)
        try:
            async with open_node(bridge):
                outcomes.append("opened")
        except (RosasyncError, OSError):
            outcomes.append("refused")
        for descriptor in taken:
            os.close(descriptor)
        gc.collect()
        assert count_descriptors() == before, (spare, outcomes)
    print("\\noutcomes:", *outcomes, flush=True)

asyncio.run(main(sys.argv[1]))
"""


async def test_a_process_without_descriptors_opens_no_node_and_leaks_none(bridge: Bridge) -> None:
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-c", FULL, bridge),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        cwd=ROOT,
    )
    output, errors = await process.communicate()
    assert process.returncode == 0, errors.decode()
    # Fast DDS logs to the same stream.
    lines = [line.split() for line in output.decode().splitlines()]
    outcomes = next(line[1:] for line in lines if line[:1] == ["outcomes:"])
    assert (outcomes[0], outcomes[-1]) == ("refused", "opened")


def no_descriptor(*_: Any) -> int:
    raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))


class TestOutOfDescriptors:
    """EMFILE: whatever was created is destroyed, and what existed before still works."""

    async def test_the_first_client_and_service(self, monkeypatch: pytest.MonkeyPatch) -> None:
        async with open_node("direct") as opened:
            before = len(list(opened.ros.node.clients)), len(list(opened.ros.node.services))
            monkeypatch.setattr(os, "eventfd", no_descriptor)
            for opening in (opened.client, opened.serve):
                with pytest.raises(OSError, match="open files"):
                    opening()
            after = len(list(opened.ros.node.clients)), len(list(opened.ros.node.services))
            assert after == before

    async def test_further_ones_share_an_eventfd(
        self, monkeypatch: pytest.MonkeyPatch, echo: str
    ) -> None:
        async with open_node("direct") as opened:
            clients = [opened.client(echo)]
            monkeypatch.setattr(os, "eventfd", no_descriptor)
            clients += [opened.client(echo) for _ in range(3)]
            await until(lambda: all(client.ready() for client in clients))
            for number, client in enumerate(clients):
                client.send(request_of(str(number)))
            await until(lambda: len(opened.responses) == 4)
            clients[0].close()
            clients[1].send(request_of("last"))
            await until(lambda: len(opened.responses) == 5)

    async def test_an_eventfd_that_cannot_be_watched(self, monkeypatch: pytest.MonkeyPatch) -> None:
        async with open_node("direct") as opened:
            loop = asyncio.get_running_loop()

            def refusing(*_: Any) -> None:
                raise OSError(errno.ENOSPC, "epoll")

            before = count_descriptors()
            monkeypatch.setattr(loop, "add_reader", refusing)
            with pytest.raises(OSError, match="epoll"):
                opened.client()
            assert count_descriptors() == before
            monkeypatch.undo()
        assert signals.MOST < 100

    async def test_a_thread_that_cannot_be_started(
        self, bridge: Bridge, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def refusing(thread: threading.Thread) -> None:
            raise RuntimeError("can't start new thread")

        async with open_node(bridge):
            pass
        with borrowed_node() as node:
            with monkeypatch.context() as patch:
                patch.setattr(threading.Thread, "start", refusing)
                with pytest.raises(RuntimeError, match="new thread"):
                    async with open_node(bridge, node):
                        pass
            assert node.executor is None
            assert not [w for w in node.waitables if "Graph" in type(w).__name__]
            async with open_node(bridge, node) as opened:
                assert opened.ros.ok()


async def test_stop_takes_no_lock(bridge: Bridge) -> None:
    """The garbage collector may call it in a thread that holds these locks."""
    async with open_node(bridge) as opened:
        executor = opened.ros.node.executor
        locks = (executor._tasks_lock, executor._nodes_lock, executor._shutdown_lock)
        stopper = threading.Thread(target=opened.ros.stop)
        for lock in locks:
            lock.acquire()
        stopper.start()
        stopper.join(LIMIT)
        stopped = not stopper.is_alive()
        for lock in locks:
            lock.release()
        stopper.join()
        assert stopped


async def test_a_users_executor_that_was_shut_down(bridge: Bridge) -> None:
    context = rclpy.Context()
    rclpy.init(context=context, signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("lender", context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    async with open_node(bridge, node) as opened:
        assert opened.ros.executor_thread is None
        executor.shutdown()
    node.destroy_node()
    context.shutdown()
