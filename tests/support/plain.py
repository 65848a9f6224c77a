"""A service of plain Python, for the graph in memory."""

from __future__ import annotations

__all__ = ["Echo", "echo"]


class Echo:
    """Returns what it is sent."""

    class Request:
        def __init__(self, value: object = None) -> None:
            self.value = value

    class Response:
        def __init__(self, value: object = None) -> None:
            self.value = value


def echo(request: Echo.Request) -> Echo.Response:
    return Echo.Response(request.value)
