"""The inner nodes of a hand-written tree with plain functions as ticks; the examples add leaves."""

import enum
from typing import Protocol


class Status(enum.Enum):
    RUNNING = enum.auto()
    SUCCESS = enum.auto()
    FAILURE = enum.auto()


class Node(Protocol):
    def tick(self) -> Status: ...

    def halt(self) -> None: ...


class Sequence:
    """Ticks its children in order, and continues as long as each ends with `go_on`."""

    go_on, stop = Status.SUCCESS, Status.FAILURE

    def __init__(self, *children: Node) -> None:
        self.children = children
        self.current = 0

    def tick(self) -> Status:
        while self.current < len(self.children):
            status = self.children[self.current].tick()
            if status is Status.RUNNING:
                return status
            self.current += 1
            if status is self.stop:
                self.current = 0
                return status
        self.current = 0
        return self.go_on

    def halt(self) -> None:
        self.current = 0
        for child in self.children:
            child.halt()


class Fallback(Sequence):
    go_on, stop = Status.FAILURE, Status.SUCCESS


class Parallel:
    """Ticks its children until all have ended."""

    def __init__(self, *children: Node) -> None:
        self.children = children
        self.ended: dict[Node, Status] = {}

    def tick(self) -> Status:
        for child in self.children:
            if child not in self.ended and (status := child.tick()) is not Status.RUNNING:
                self.ended[child] = status
        if len(self.ended) < len(self.children):
            return Status.RUNNING
        failed = Status.FAILURE in self.ended.values()
        self.ended.clear()
        return Status.FAILURE if failed else Status.SUCCESS

    def halt(self) -> None:
        self.ended.clear()
        for child in self.children:
            child.halt()
