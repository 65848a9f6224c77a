"""Exit codes, and the one line that an error prints."""

from __future__ import annotations

from collections.abc import Collection
from enum import IntEnum

import rosasync

__all__ = ["CliError", "Code", "code_of", "code_of_all", "join", "line_of"]


class Code(IntEnum):
    """The exit codes of every command."""

    ANSWERED = 0
    FAILED = 1
    USAGE = 2
    NO_SERVER = 3
    TIMED_OUT = 4
    SERVER_GONE = 5
    PIPE_CLOSED = 141


class CliError(Exception):
    """An error that ends the command: the message, and the exit code."""

    def __init__(self, message: str, code: Code = Code.USAGE) -> None:
        super().__init__(message)
        self.code = code


_CODES: tuple[tuple[type[Exception], Code], ...] = (
    (rosasync.ServiceUnavailable, Code.NO_SERVER),
    (rosasync.ResponseTimeout, Code.TIMED_OUT),
    (rosasync.GoalTimeout, Code.TIMED_OUT),
    (rosasync.ServerGone, Code.SERVER_GONE),
    (rosasync.InvalidServiceName, Code.USAGE),
)

_ADVICE: tuple[tuple[type[Exception], str], ...] = (
    (rosasync.ServiceUnavailable, "Try: rosasync why {name}"),
    (rosasync.ResponseTimeout, "The server may still run it. Try a longer --timeout"),
    (rosasync.ServerGone, "The server may have run it. Call again when it is back"),
    (rosasync.ServerOverloaded, "It did not run. Call again later, or less often"),
    (rosasync.HandlerFailed, "The server's log has the traceback"),
    (rosasync.QueueTimeout, "Nothing was sent. Try a lower --concurrency or --rate"),
    (rosasync.InvalidServiceName, "Try: rosasync list"),
)

_ACTION_ADVICE: tuple[tuple[type[Exception], str], ...] = (
    (rosasync.ServiceUnavailable, "Try: rosasync action info {name}"),
    (rosasync.ServerGone, "Its goals are lost. Send the goal again when it is back"),
    (rosasync.GoalTimeout, "It is cancelled. Try a longer --accept-timeout"),
)
"""The advice for the errors of goals, whose types are those of actions."""


def code_of(error: BaseException) -> Code:
    """Return the exit code for an error."""
    if isinstance(error, CliError):
        return error.code
    return next((code for kind, code in _CODES if isinstance(error, kind)), Code.FAILED)


def code_of_all(codes: Collection[Code]) -> Code:
    """Return the exit code for several failures: theirs, if they are all of one kind."""
    if not codes:
        return Code.ANSWERED
    return next(iter(codes)) if len({*codes}) == 1 else Code.FAILED


def line_of(error: BaseException) -> str:
    """Return an error as one line that says what to do next."""
    text = " ".join(str(error).split()) or type(error).__name__
    table = _ACTION_ADVICE if "/action/" in getattr(error, "srv_type", "") else _ADVICE
    advice = next((advice for kind, advice in table if isinstance(error, kind)), "")
    if not advice:
        return text
    return join(text, advice.format(name=getattr(error, "srv_name", "")))


def join(text: str, advice: str) -> str:
    """Return two sentences in a line."""
    return f"{text}{'' if text.endswith(('.', '?', '!')) else '.'} {advice}"
