"""StatusList: the goals of a server as the bytes of an ``action_msgs/msg/GoalStatusArray``.

The message lists every goal that has not expired, and is published at each change of any of them.
Converting it costs about 3 µs for each goal listed, so a server with thousands of results in its
cache would do little else. Its elements all have the same length, so each goal keeps its own.
"""

from __future__ import annotations

import struct
from typing import Any

__all__ = ["StatusList", "decode_statuses"]

HEADER = bytes((0, 1, 0, 0))
"""The encapsulation header of CDR, little-endian."""
ELEMENT = struct.Struct("<16s3xiIb")
"""A ``GoalStatus``: goal id, seconds and nanoseconds of the stamp, status. The padding aligns the
stamp; the first element needs none, because it follows the number of elements."""
FIRST_PADDING = slice(16, 19)
PADDING = 3
NANOSECONDS = 1_000_000_000


class StatusList:
    """The elements of the message, in the order in which the goals were added."""

    def __init__(self) -> None:
        self._elements: dict[bytes, bytes] = {}

    def __len__(self) -> int:
        return len(self._elements)

    def set(self, goal_id: bytes, stamp: int, status: int) -> None:
        """Add a goal, or change its status.

        Args:
            goal_id: the 16 bytes of its id.
            stamp: when it was accepted, in ns.
            status: its status.
        """
        seconds, nanoseconds = divmod(stamp, NANOSECONDS)
        self._elements[goal_id] = ELEMENT.pack(goal_id, seconds, nanoseconds, status)

    def remove(self, goal_id: bytes) -> None:
        """Remove a goal."""
        del self._elements[goal_id]

    def encode(self) -> bytes:
        """Return the serialized message."""
        count = len(self._elements)
        elements = bytearray().join(self._elements.values())
        del elements[FIRST_PADDING]
        return HEADER + count.to_bytes(4, "little") + elements


def decode_statuses(encoded: bytes) -> dict[str, Any]:
    """Return the fields of the message that a `StatusList` has encoded."""
    elements = bytearray(encoded[len(HEADER) + 4 :])
    elements[FIRST_PADDING.start : FIRST_PADDING.start] = bytes(PADDING)
    return {
        "status_list": [
            {
                "goal_info": {
                    "goal_id": {"uuid": goal_id},
                    "stamp": {"sec": seconds, "nanosec": nanoseconds},
                },
                "status": status,
            }
            for goal_id, seconds, nanoseconds, status in ELEMENT.iter_unpack(
                elements if len(encoded) > len(HEADER) + 4 else b""
            )
        ]
    }
