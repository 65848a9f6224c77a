"""Rules of stubs: which answers to which requests."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Generic, TypeAlias, TypeVar

from rosasync._ros.messages import to_dict
from rosasync.testing._matching import matches

__all__ = ["Match", "Rule", "take_answer"]

Match: TypeAlias = Mapping[str, Any] | Callable[[Any], bool] | None
"""Which requests: a mapping of the fields that count, a function of the request, None for all."""

AnswerT = TypeVar("AnswerT")


@dataclass
class Rule(Generic[AnswerT]):
    """Answers to the requests that match. A single one is repeated, several are given in turn."""

    match: Match
    answers: list[AnswerT]
    repeated: bool

    @classmethod
    def of(cls, match: Match, answers: list[AnswerT]) -> Rule[AnswerT]:
        """Make a rule of one answer, or of several."""
        return cls(match, answers, repeated=len(answers) == 1)

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


def take_answer(rules: list[Rule[AnswerT]], request: Any) -> AnswerT | None:
    """Return the next answer of the first rule that fits a request; None if there is none."""
    rule = next((rule for rule in rules if rule.fits(request)), None)
    return None if rule is None else rule.take()
