"""The estimated size of messages."""

from __future__ import annotations

import array
from typing import Any

import numpy
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from diagnostic_msgs.srv import AddDiagnostics
from nav_msgs.msg import OccupancyGrid
from std_srvs.srv import Empty

from rosasync._server.sizes import payload_size


@pytest.mark.parametrize(
    ("value", "least"),
    [
        ("x" * 1_000, 1_000),
        (b"x" * 1_000, 1_000),
        (array.array("d", [0.0] * 1_000), 8_000),
        (numpy.zeros(1_000), 8_000),
        ([1] * 1_000, 1_000),
        ([], 0),
        (None, 1),
        (AddDiagnostics.Request(load_namespace="x" * 1_000), 1_000),
        (OccupancyGrid(data=[1] * 1_000), 1_000),
        (
            DiagnosticArray(status=[DiagnosticStatus(values=[KeyValue(value="x" * 500)] * 2)] * 2),
            2_000,
        ),
        (Empty.Request(), 0),
    ],
)
def test_a_size_is_the_payload_and_little_more(value: Any, least: int) -> None:
    assert least <= payload_size(value) <= 8 * least + 1_000
