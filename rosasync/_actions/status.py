"""GoalStatus, and the identifiers of goals."""

from __future__ import annotations

import enum
import struct
from collections.abc import Iterator

__all__ = ["TERMINAL", "GoalStatus", "read_statuses", "uuid_bytes", "uuid_of"]


class GoalStatus(enum.IntEnum):
    """The status of a goal, with the values of ``action_msgs/msg/GoalStatus``.

    Attributes:
        UNKNOWN: it is not accepted yet, or the server does not know it.
        ACCEPTED: the server has accepted it, and has not started it.
        EXECUTING: it runs.
        CANCELING: the server has agreed to cancel it, and it has not ended yet.
        SUCCEEDED: it has ended as it should.
        CANCELED: it has ended because it was cancelled.
        ABORTED: the server has given up.
    """

    UNKNOWN = 0
    ACCEPTED = 1
    EXECUTING = 2
    CANCELING = 3
    SUCCEEDED = 4
    CANCELED = 5
    ABORTED = 6


TERMINAL = frozenset({GoalStatus.SUCCEEDED, GoalStatus.CANCELED, GoalStatus.ABORTED})
"""The statuses of a goal that has ended."""

UUID_AT = slice(4, 20)
"""Where a serialized feedback message has the UUID of its goal: behind the CDR header."""

_FIRST = 8
_FIRST_STATUS = 32
_NEXT = struct.Struct("16s11xb")


def uuid_of(message: object) -> bytes:
    """Return the bytes of a ``unique_identifier_msgs/msg/UUID``."""
    return bytes(message.uuid)  # type: ignore[attr-defined]


def uuid_bytes(serialized: bytes) -> bytes:
    """Return the bytes of the UUID of a serialized feedback message."""
    return serialized[UUID_AT]


def read_statuses(serialized: bytes) -> Iterator[tuple[bytes, int]] | None:
    """Read a serialized ``action_msgs/msg/GoalStatusArray`` without deserializing it.

    A server lists every goal of the last minutes in each of these, so they are long and many.

    Returns:
        The UUIDs and statuses; None if the bytes are not laid out as expected.
    """
    little = serialized[1:2] == b"\x01"
    count = int.from_bytes(serialized[4:8], "little" if little else "big")
    if not count and len(serialized) >= 8:
        return iter(())
    size = _FIRST_STATUS + 1 + _NEXT.size * (count - 1)
    # The middleware pads what comes from another process to a multiple of four bytes.
    if not 0 <= len(serialized) - size < 4:
        return None
    return _read(memoryview(serialized)[:size])


def _read(serialized: memoryview) -> Iterator[tuple[bytes, int]]:
    # Only numbers are aligned, so the first element lacks the padding of the others.
    yield bytes(serialized[_FIRST : _FIRST + 16]), serialized[_FIRST_STATUS]
    yield from _NEXT.iter_unpack(serialized[_FIRST_STATUS + 1 :])
