"""The plain rclpy peers of the demo: a server process and threaded ``client.call``.

``python -m rosasync._demo.stock [--bare] SRV_NAME …`` serves these names until its standard input
ends, in an executor's callbacks or in a bare loop.
"""

from __future__ import annotations

import os
import sys
import threading
from contextlib import suppress
from typing import Any

import rclpy
from diagnostic_msgs.srv import AddDiagnostics
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.signals import SignalHandlerOptions

__all__ = ["READY", "ThreadedClient", "answer_of", "request_for", "serve"]

READY = b"ready\n"
"""The server process writes this to its standard output when its services exist."""

Echo = AddDiagnostics
"""The stock service type with a text in both request and response, as needed for an echo."""


def request_for(text: str) -> Any:
    """Return a request to echo ``text``."""
    return Echo.Request(load_namespace=text)


def answer_of(response: Any) -> str:
    """Return the text in a response."""
    return str(response.message)


def serve(*srv_names: str, bare: bool = False) -> None:
    """Serve an echo under each name until standard input ends.

    Blocks the calling thread, and needs the process for itself. The pipe is closed when the parent
    ends, also if it is killed, so the server never outlives its parent.

    Args:
        srv_names: the services.
        bare: take and answer the requests in a loop around one wait set, which is about the least
            that a server can do. Otherwise a SingleThreadedExecutor calls a callback for each.
    """
    context = Context()
    rclpy.init(context=context)
    node = rclpy.create_node("rosasync_stock_server", context=context)
    services = [node.create_service(Echo, srv_name, _echo) for srv_name in srv_names]
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        if bare:
            _answer_in_a_loop(context, [service.handle for service in services])
        else:
            _spin(node)
    node.destroy_node()
    rclpy.try_shutdown(context=context)


def _begin(context: Context) -> None:
    """Say that the server is ready; it may end from here on.

    Called when all is made that needs the context: standard input may have ended already.
    """
    threading.Thread(target=_shut_down_at_end_of_input, args=(context,), daemon=True).start()
    os.write(sys.stdout.fileno(), READY)


def _spin(node: Any) -> None:
    executor = SingleThreadedExecutor(context=node.context)
    executor.add_node(node)
    _begin(node.context)
    try:
        executor.spin()
    finally:
        executor.shutdown()


def _answer_in_a_loop(context: Context, services: list[Any]) -> None:
    guard = _rclpy.GuardCondition(context.handle)
    context.on_shutdown(guard.trigger_guard_condition)
    wait_set = _rclpy.WaitSet(0, 1, 0, 0, len(services), 0, context.handle)
    _begin(context)
    while context.ok():
        wait_set.clear_entities()
        wait_set.add_guard_condition(guard)
        for service in services:
            wait_set.add_service(service)
        wait_set.wait(-1)
        try:
            for service in services:
                _answer_all(service)
        except _rclpy.RCLError:
            # Ctrl-C may shut the context down in the middle.
            if context.ok():
                raise
    wait_set.destroy_when_not_in_use()
    guard.destroy_when_not_in_use()


def _answer_all(service: Any) -> None:
    while (taken := service.service_take_request(Echo.Request))[0] is not None:
        request, header = taken
        service.service_send_response(_echo(request, Echo.Response()), header.request_id)


def _echo(request: Any, response: Any) -> Any:
    response.success = True
    response.message = request.load_namespace
    return response


def _shut_down_at_end_of_input(context: Context) -> None:
    # Not sys.stdin: a daemon thread that reads from it holds its lock at exit.
    while os.read(0, 1024):
        pass
    rclpy.try_shutdown(context=context)


class ThreadedClient:
    """``client.call`` as it is commonly used: a SingleThreadedExecutor spins in a thread.

    Its methods block. Call them from any other thread, and call `close` at the end.
    """

    def __init__(self, srv_name: str) -> None:
        self._context = Context()
        rclpy.init(context=self._context, signal_handler_options=SignalHandlerOptions.NO)
        # Two nodes of one name would share the topic of their logs, which rclpy warns about.
        name = "rosasync_stock_client" + srv_name.replace("/", "_")
        self._node = rclpy.create_node(name, context=self._context)
        self._client = self._node.create_client(Echo, srv_name)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._thread = threading.Thread(target=self._spin, name="stock executor")
        self._thread.start()

    def wait_for_service(self, timeout: float) -> bool:
        """Wait up to ``timeout`` seconds for the server, and return whether there is one."""
        return bool(self._client.wait_for_service(timeout_sec=timeout))

    def call(self, request: Any, timeout: float) -> Any:
        """Call the service and wait up to ``timeout`` seconds for the response.

        Raises:
            TimeoutError: no response came in time.
        """
        response = self._client.call(request, timeout_sec=timeout)
        if response is None:  # on Jazzy, instead of TimeoutError
            raise TimeoutError(f"client.call: no response within {timeout} s")
        return response

    def close(self) -> None:
        """End the thread, the node and the context."""
        self._context.try_shutdown()
        self._thread.join()
        self._executor.shutdown()
        self._node.destroy_node()

    def _spin(self) -> None:
        with suppress(ExternalShutdownException):
            self._executor.spin()


if __name__ == "__main__":
    names = [argument for argument in sys.argv[1:] if argument != "--bare"]
    serve(*names, bare="--bare" in sys.argv)
