"""Numbers in messages."""

from __future__ import annotations

import pytest

from rosasync._core.text import duration


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0.0, "0 ms"),
        (0.00195, "1.9 ms"),
        (0.05, "50 ms"),
        (0.099, "99 ms"),
        (0.0999, "0.1 s"),
        (0.501, "0.5 s"),
        (3.01, "3 s"),
        (12.34, "12 s"),
        (99.7, "100 s"),
        (1234.5, "1234 s"),
    ],
)
def test_a_duration_has_two_digits(seconds: float, text: str) -> None:
    assert duration(seconds) == text
