"""``rosasync action serve``: a stub of an action, or a handler of the user's own."""

from __future__ import annotations

import asyncio
import inspect
import random
from dataclasses import dataclass
from typing import Any

import rosasync
from rosasync._cli.actions import action_class
from rosasync._cli.documents import plain
from rosasync._cli.errors import CliError
from rosasync._cli.output import note, print_value
from rosasync._cli.requests import message_from
from rosasync._cli.run import open_session
from rosasync._cli.serve import load_handler
from rosasync._cli.streams import OutputError

__all__ = ["Behaviour", "serve_action"]

CLOSE_TIMEOUT = 0.5
"""Seconds for which Ctrl-C lets cancelled handlers end."""


@dataclass(frozen=True)
class Behaviour:
    """How a stub runs goals."""

    result: str | None = None
    feedback: tuple[str, ...] = ()
    delay: float = 0.0
    reject_rate: float = 0.0
    abort_rate: float = 0.0


async def serve_action(
    name: str,
    action_type: str,
    behaviour: Behaviour,
    on_busy: str,
    handler: str | None,
    as_json: bool,
) -> None:
    """Serve an action until the task is cancelled."""
    found = action_class(action_type)
    if handler is None:
        handle = _Stub(found, behaviour).run
    elif behaviour == Behaviour():
        handle = load_handler(handler)
        if not inspect.iscoroutinefunction(handle):
            raise CliError(f"--handler {handler}: a handler of goals must be async")
    else:
        raise CliError("--handler runs the goals itself: leave out the options of the stub")
    failure: asyncio.Future[None] = asyncio.get_running_loop().create_future()
    printer = _Printer(as_json, failure)

    async def printing(goal: rosasync.ServerGoal[Any, Any]) -> Any:
        printer.print_goal(goal)
        try:
            return await handle(goal)
        finally:
            # In the next turn the goal has its end.
            asyncio.get_running_loop().call_soon(printer.print_end, goal)

    def on_goal(request: Any) -> bool:
        accepted = random.random() >= behaviour.reject_rate
        if not accepted:
            note("rejected a goal")
        return accepted

    async with open_session() as session:
        server = _start(session, found, name, printing, on_goal, on_busy)
        note(f"serving {name} [{action_type}]; Ctrl-C ends it")
        try:
            await failure
        finally:
            await server.aclose(CLOSE_TIMEOUT)
            counts = server.statistics()
            note(
                f"goals: {counts.accepted} accepted, {counts.rejected} rejected; "
                f"{counts.succeeded} succeeded, {counts.canceled} canceled, "
                f"{counts.aborted} aborted"
            )


def _start(
    session: rosasync.Session, found: Any, name: str, handler: Any, on_goal: Any, on_busy: Any
) -> rosasync.ActionServer[Any, Any, Any]:
    try:
        return session.serve_action(found, name, handler, on_goal=on_goal, on_busy=on_busy)
    except ValueError as error:
        if isinstance(error, rosasync.InvalidServiceName):
            raise
        raise CliError(f"--on-busy {on_busy}: {error}") from None


class _Printer:
    """Prints goals and their ends; an error of the output is ``failure``."""

    def __init__(self, as_json: bool, failure: asyncio.Future[None]) -> None:
        self._as_json = as_json
        self._failure = failure
        self._printed = 0

    def print_goal(self, goal: rosasync.ServerGoal[Any, Any]) -> None:
        fields = plain(goal.request)
        if self._as_json:
            self._print({"goal_id": str(goal.id), "goal": fields})
        else:
            note(f"goal {goal.id}")
            self._print(fields)

    def print_end(self, goal: rosasync.ServerGoal[Any, Any]) -> None:
        if self._as_json:
            self._print({"goal_id": str(goal.id), "status": goal.status.name})
        else:
            note(f"goal {goal.id}: {goal.status.name}")

    def _print(self, value: Any) -> None:
        try:
            print_value(value, as_json=self._as_json, separate=self._printed > 0)
        except OutputError as error:
            if not self._failure.done():
                self._failure.set_exception(error)
        self._printed += 1


class _Stub:
    """Runs goals as the options say."""

    def __init__(self, action: type[Any], behaviour: Behaviour) -> None:
        self._behaviour = behaviour
        self._result = message_from(action.Result, behaviour.result)
        self._feedback = [message_from(action.Feedback, text) for text in behaviour.feedback]

    async def run(self, goal: rosasync.ServerGoal[Any, Any]) -> Any:
        """Run one goal."""
        for message in self._feedback:
            await asyncio.sleep(self._behaviour.delay)
            goal.feedback(message)
        await asyncio.sleep(self._behaviour.delay)
        if random.random() < self._behaviour.abort_rate:
            raise rosasync.GoalAborted("aborted: --abort-rate", result=self._result)
        return self._result
