"""Action types by their names. Needs no rclpy."""

from __future__ import annotations

import difflib
import functools
import re
from typing import Any

from rosasync._ros.types import load_definitions, type_name

__all__ = ["action_type"]

_ACTION_NAME = re.compile(r"([a-z]\w*)/action/([a-z]\w*)", re.ASCII | re.IGNORECASE)

_SHAPE = ("Goal", "Result", "Feedback", "Impl")


def action_type(wanted: type[Any] | str) -> type[Any]:
    """Resolve an action class from a class or a name.

    Args:
        wanted: an action class, or its name, ``"test_msgs/action/Fibonacci"``.

    Raises:
        TypeError: neither an action class nor a string.
        ValueError: the name is malformed, or no such action is installed.
    """
    if isinstance(wanted, str):
        return _action_named(wanted)
    if not isinstance(wanted, type):
        raise TypeError(
            "expected an action class, or its name such as 'nav2_msgs/action/NavigateToPose', "
            f"got {type(wanted).__name__}"
        )
    if not _is_action(wanted):
        raise TypeError(
            f"{type_name(wanted)} is not an action: it has no Goal, Result and Feedback"
        )
    return wanted


def _is_action(candidate: object) -> bool:
    return isinstance(candidate, type) and all(
        isinstance(getattr(candidate, name, None), type) for name in _SHAPE
    )


@functools.cache
def _action_named(name: str) -> type[Any]:
    match = _ACTION_NAME.fullmatch(name)
    if match is None:
        raise ValueError(
            f"{name!r} does not name an action type: expected 'package/action/Type', "
            "such as 'nav2_msgs/action/NavigateToPose'"
        )
    package, wanted = match.groups()
    actions: dict[str, type[Any]] = {
        key: found
        for key, found in load_definitions(package, "action", "actions", name).items()
        if _is_action(found)
    }
    if wanted not in actions:
        similar = difflib.get_close_matches(wanted, actions, n=1)
        hint = f"; did you mean '{package}/action/{similar[0]}'?" if similar else ""
        raise ValueError(f"{name!r}: no such action in {package}{hint}")
    return actions[wanted]
