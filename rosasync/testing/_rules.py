"""Rules of stubs: which answers to which requests."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Generic, TypeAlias, TypeVar

from rosasync._ros.messages import to_dict
from rosasync.testing._matching import check_fields, matches

__all__ = ["Match", "Rules"]

logger = logging.getLogger("rosasync")

AnswerT = TypeVar("AnswerT")
AskedT = TypeVar("AskedT")

Match: TypeAlias = Mapping[str, Any] | Callable[[AskedT], bool] | None
"""Which requests: a mapping of the fields that count, a function of the request, None for all."""


@dataclass
class Rule(Generic[AnswerT]):
    """Answers to the requests that match. A single one is repeated, several are given in turn."""

    match: Match[Any]
    answers: list[AnswerT]
    repeated: bool

    def fits(self, request: Any) -> bool:
        """Return whether the rule matches a request, and has an answer left."""
        if not self.answers:
            return False
        if callable(self.match):
            return bool(self.match(request))
        return self.match is None or matches(self.match, to_dict(request))

    def take(self) -> AnswerT:
        """Return the next answer."""
        return self.answers[0] if self.repeated else self.answers.pop(0)


class Rules(Generic[AnswerT]):
    """The rules of one stub.

    Args:
        request_type: the message class of the requests, or of the goals.
        on_unexpected: called with a sentence if a request has no answer.
    """

    def __init__(self, request_type: type[Any], on_unexpected: Callable[[str], None]) -> None:
        self._request_type = request_type
        self._on_unexpected = on_unexpected
        self._rules: list[Rule[AnswerT]] = []

    def check(self, name: str, match: Match[Any], answers: tuple[object, ...]) -> None:
        """Check the arguments of a rule before its answers are prepared.

        Raises:
            TypeError: ``match`` is neither a mapping nor a function.
            ValueError: there is no answer, or the request has no such field.
        """
        if not answers:
            raise ValueError(f"{name}: answer() takes at least one answer")
        if isinstance(match, Mapping):
            check_fields(self._request_type, match)
        elif match is not None and not callable(match):
            kind = type(match).__name__
            raise TypeError(f"match must be a mapping of fields, a function or None, not {kind}")

    def add(self, match: Match[Any], answers: list[AnswerT]) -> None:
        """Add a rule behind the others."""
        self._rules.append(Rule(match, answers, repeated=len(answers) == 1))

    def take(self, name: str, request: Any) -> AnswerT | None:
        """Return the next answer of the first rule that fits; if none does, report it."""
        for rule in self._rules:
            if rule.fits(request):
                return rule.take()
        problem = f"{name} has no answer left for {to_dict(request)}"
        logger.warning("%s", problem)
        self._on_unexpected(problem)
        return None
