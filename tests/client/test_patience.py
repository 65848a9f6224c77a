"""What callers that left without notice say of those that wait: a table."""

from __future__ import annotations

import pytest

from rosasync._client.patience import NOBODY_LEAVES, Patience

Left = list[tuple[float, float]]
"""When callers left, and for how long each had waited."""


def steadily(waits: list[float], every: float = 0.1) -> Left:
    return [(number * every, waited) for number, waited in enumerate(waits)]


@pytest.mark.parametrize(
    ("left", "now", "expected"),
    [
        ([], 0.0, NOBODY_LEAVES),
        (steadily([1.0] * 4), 0.5, NOBODY_LEAVES),
        (steadily([1.0] * 5), 0.5, (1.0, 1.0)),
        # All at once, as when a tree is halted; and twice, with a pause between.
        (steadily([1.0] * 50, every=0.0), 0.0, NOBODY_LEAVES),
        ([*[(0.0, 0.1)] * 50, *[(5.0, 0.1)] * 50], 5.0, NOBODY_LEAVES),
        # One in ten leaves sooner.
        (steadily([0.1, *[0.5] * 8, 2.0]), 1.0, (0.5, 2.0)),
        (steadily([0.1, 0.2, *[0.5] * 17, 2.0]), 2.0, (0.5, 2.0)),
        # For a second, or for as long as the last one had waited.
        (steadily([0.2] * 5), 1.39, (0.2, 0.2)),
        (steadily([0.2] * 5), 1.4, NOBODY_LEAVES),
        (steadily([3.0] * 5), 3.39, (3.0, 3.0)),
        (steadily([3.0] * 5), 3.4, NOBODY_LEAVES),
        # What is old does not count, nor do more than a hundred.
        (steadily([0.2] * 5) + [(0.9 * n, 0.5) for n in range(1, 21)], 18.0, (0.5, 0.5)),
        (steadily([0.1] * 50 + [0.5] * 100, every=0.01), 1.5, (0.5, 0.5)),
    ],
)
def test_what_those_that_left_say(left: Left, now: float, expected: tuple[float, float]) -> None:
    patience = Patience()
    for at, waited in left:
        patience.add(waited, at)
    assert patience.waits(now) == expected
