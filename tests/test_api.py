"""The public API changes only together with a line in the changelog."""

from __future__ import annotations

from tests.support.api import public_api, recorded


def test_the_public_api_is_the_recorded_one() -> None:
    _, before = recorded()
    now = public_api()
    removed = [f"- {line}" for line in before if line not in now]
    added = [f"+ {line}" for line in now if line not in before]
    assert not removed + added, (
        "the public API has changed. Say so in docs/changelog.md, then run "
        "`python -m tests.support.api`:\n" + "\n".join(removed + added)
    )
