"""Plain rclpy on both ends, to show rosasync beside: a server process and threaded ``client.call``.

``python -m rosasync.demo.stock SRV_NAME …`` serves those names until its standard input ends.
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
"""What the server process writes to its standard output once its services are there."""

Echo = AddDiagnostics
"""Of the stock service types, the one that carries a text both ways, so that it can echo."""


def request_for(text: str) -> Any:
    """Return a request that asks for ``text`` to be echoed."""
    return Echo.Request(load_namespace=text)


def answer_of(response: Any) -> str:
    """Return the text that a response echoes."""
    return str(response.message)


def serve(*srv_names: str) -> None:
    """Serve an echo under each name with a SingleThreadedExecutor, until standard input ends.

    Takes over the calling thread, and is meant to be all that its process does. The pipe ends with
    the parent, however that ends, so no server outlives it.
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
    # os.read and not sys.stdin: a daemon thread inside sys.stdin holds its lock at exit.
    while os.read(0, 1024):
        pass
    rclpy.try_shutdown(context=context)


class ThreadedClient:
    """``client.call`` as rclpy's users make it: a SingleThreadedExecutor spins in a thread.

    Its methods block and may be called from any thread but its own. To be closed.
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
        """Wait up to ``timeout`` seconds for the server; return whether it is there."""
        return bool(self._client.wait_for_service(timeout_sec=timeout))

    def call(self, request: Any, timeout: float) -> Any:
        """Call, and wait up to ``timeout`` seconds for the response.

        Raises:
            TimeoutError: no response came in time.
        """
        response = self._client.call(request, timeout_sec=timeout)
        if response is None:  # how Jazzy's client.call says that the time is up
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
