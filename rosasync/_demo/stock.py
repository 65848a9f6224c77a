"""The plain rclpy peers of the demo: a server process and threaded ``client.call``.

``python -m rosasync._demo.stock SRV_NAME …`` serves these names until its standard input ends.
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


def serve(*srv_names: str) -> None:
    """Serve an echo under each name with a SingleThreadedExecutor, until standard input ends.

    Blocks the calling thread, and needs the process for itself. The pipe is closed when the parent
    ends, also if it is killed, so the server never outlives its parent.
    """
    context = Context()
    rclpy.init(context=context)
    node = rclpy.create_node("rosasync_stock_server", context=context)
    for srv_name in srv_names:
        node.create_service(Echo, srv_name, _echo)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    threading.Thread(target=_shut_down_at_end_of_input, args=(context,), daemon=True).start()
    os.write(sys.stdout.fileno(), READY)
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        executor.spin()
    executor.shutdown()
    node.destroy_node()
    rclpy.try_shutdown(context=context)


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
        self._node = rclpy.create_node("rosasync_stock_client", context=self._context)
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
    serve(*sys.argv[1:])
