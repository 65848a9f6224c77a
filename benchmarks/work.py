"""The work of a contestant, with its requests, responses and handlers."""

from __future__ import annotations

import array
import dataclasses
import importlib
import random
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

__all__ = [
    "CALL_TIMEOUT",
    "LIMITED",
    "READY_TIMEOUT",
    "SERVERS",
    "Work",
    "async_handler",
    "handled",
    "handling_time",
    "load_type",
    "make_handler",
    "make_qos",
    "make_request",
    "make_response",
]

CALL_TIMEOUT = 2.0
"""Seconds after which a call counts as lost, if the contestant supports deadlines."""

READY_TIMEOUT = 30.0
"""Seconds that a contestant may take to find its servers."""

SERVERS = {
    "rosasync": "direct, async",
    "rosasync-uvloop": "direct, async, uvloop",
    "rosasync-plain": "direct, plain",
    "rosasync-executor": "executor, async",
}
"""The bridge, handler and loop of each server of rosasync."""
LIMITED = {
    "rosasync-one": "direct, async, one at a time",
    "rosasync-status": "direct, async, one at a time, status",
}
"""Servers for the benchmarks of overload and goodput alone."""

handled: list[float] = []
"""When handlers with `Work.handling` finished requests in this process, on the monotonic clock."""


@dataclass(frozen=True)
class Work:
    """One kind of call.

    Attributes:
        srv_type: the service type by name.
        payload: bytes in the request (SetCameraInfo) or in the response (GetMap).
        delays: seconds until a server answers; service ``i`` has the ``i``-th, cyclically.
        services: number of services, which the calls use in turn.
        idle_clients: number of clients that are never used.
        depth: history depth of clients and servers; None for the default of each.
        server: ``stock``, an rclpy service on a SingleThreadedExecutor; ``lean``, a bare loop that
            is not the bottleneck; ``inside``, created by the contestant in its own process;
            ``stock-async``, stock with an async handler; ``stopped``, stock, and stopped by its
            first request; or one of `SERVERS` or `LIMITED`.
        handling: seconds for which a stock server's callback runs.
        exponential: whether that is a mean, of exponentially distributed times.
        busy: seconds at a time for which the contestant's thread handles no responses.
        timeout: seconds after which a call counts as lost; only some contestants use it.
        srv_name: the prefix of all service names; each turn has its own.
    """

    srv_type: str = "std_srvs/srv/Empty"
    payload: int = 0
    delays: tuple[float, ...] = (0.0,)
    services: int = 1
    idle_clients: int = 0
    depth: int | None = None
    server: str = "stock"
    handling: float = 0.0
    exponential: bool = False
    busy: float = 0.0
    timeout: float = CALL_TIMEOUT
    srv_name: str = "/bench"

    @classmethod
    def from_json(cls, data: dict[str, Any]) -> Work:
        return cls(**{**data, "delays": tuple(data["delays"])})

    def to_json(self) -> dict[str, Any]:
        return dataclasses.asdict(self)

    @property
    def names(self) -> list[str]:
        return [f"{self.srv_name}/service_{i}" for i in range(self.services)]

    @property
    def idle_names(self) -> list[str]:
        return [f"{self.srv_name}/idle_{i}" for i in range(self.idle_clients)]

    def delay(self, service: int) -> float:
        return self.delays[service % len(self.delays)]


def load_type(name: str) -> Any:
    package, kind, type_name = name.split("/")
    return getattr(importlib.import_module(f"{package}.{kind}"), type_name)


def make_request(work: Work) -> Any:
    request = load_type(work.srv_type).Request()
    if work.srv_type == "sensor_msgs/srv/SetCameraInfo":
        request.camera_info.d = array.array("d", bytes(work.payload))
    return request


def make_response(work: Work) -> Any:
    response = load_type(work.srv_type).Response()
    if work.srv_type == "nav_msgs/srv/GetMap":
        response.map.data = array.array("b", bytes(work.payload))
    return response


def make_handler(work: Work) -> Callable[[Any, Any], Any]:
    """Return a service callback that answers with a prepared response."""
    prepared = make_response(work)
    if not work.handling:
        return lambda _request, _response: prepared

    def handle(_request: Any, _response: Any) -> Any:
        time.sleep(handling_time(work))
        handled.append(time.monotonic())
        return prepared

    return handle


def async_handler(work: Work) -> Callable[[Any, Any], Any]:
    """Return the handler of `make_handler` as a coroutine function."""
    plain = make_handler(work)

    async def handler(request: Any, response: Any) -> Any:
        return plain(request, response)

    return handler


def handling_time(work: Work) -> float:
    """Return for how many seconds a server works on the next request."""
    return random.expovariate(1 / work.handling) if work.exponential else work.handling


def make_qos(depth: int | None) -> Any:
    """Return the stock service QoS, with another depth if one is given."""
    from rclpy.qos import QoSProfile, ReliabilityPolicy, qos_profile_services_default

    if depth is None:
        return qos_profile_services_default
    return QoSProfile(depth=depth, reliability=ReliabilityPolicy.RELIABLE)
