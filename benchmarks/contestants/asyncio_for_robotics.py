"""asyncio-for-robotics, as in its service client example."""

from __future__ import annotations

import asyncio
from contextlib import ExitStack
from functools import partial
from typing import Any

import asyncio_for_robotics.ros2 as afor

from benchmarks.contestants.base import Asynchronous
from benchmarks.work import (
    CALL_TIMEOUT,
    READY_TIMEOUT,
    Work,
    load_type,
    make_qos,
    make_request,
    make_response,
)


class AsyncioForRobotics(Asynchronous):
    def __init__(self, depth: int | None = None) -> None:
        self._depth = depth

    async def open(self, work: Work) -> None:
        srv_type = load_type(work.srv_type)
        depth = work.depth or self._depth
        qos = {} if depth is None else {"qos_profile": make_qos(depth)}
        self._stack = ExitStack()
        self._session = self._stack.enter_context(afor.auto_context(node="bench"))
        inside = work.names if work.server == "inside" else []
        self._serving = [asyncio.create_task(self._serve(srv_type, n, work)) for n in inside]
        self._clients = [self._client(srv_type, name, qos) for name in work.names]
        self._idle = [self._client(srv_type, name, qos) for name in work.idle_names]
        for client in self._clients:
            await asyncio.wait_for(client.wait_for_service(), READY_TIMEOUT)
        self._request = make_request(work)

    async def call(self, service: int) -> None:
        await asyncio.wait_for(self._clients[service].call(self._request), CALL_TIMEOUT)

    async def shut(self) -> None:
        for task in self._serving:
            task.cancel()
        self._stack.close()

    def _client(self, srv_type: Any, name: str, qos: dict[str, Any]) -> Any:
        return afor.Client(srv_type, name, session=self._session, **qos)

    async def _serve(self, srv_type: Any, name: str, work: Work) -> None:
        response = make_response(work)
        server = afor.Server(srv_type, name, session=self._session)
        async for responder in server.listen_reliable():
            responder.send(response)


CONTESTANTS = {
    "afor": AsyncioForRobotics,
    "afor-qos": partial(AsyncioForRobotics, depth=10),
}
