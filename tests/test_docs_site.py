"""The site of the documentation: built without a warning, linked to the reference, searchable."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

from sphinx.search.en import SearchEnglish

from tests.support.process import ROOT

PAINS = {
    1: "call never returns",
    2: "deadlock callback",
    3: "await rclpy future asyncio",
    4: "first response lost",
    5: "timeout pending requests leak",
    6: "crash destroying clients",
    7: "client per tree node slow",
    8: "silently dropped load",
    9: "service not found",
    10: "server exception dies",
    11: "behaviour tree tick stale result",
    12: "high CPU usage executor",
    13: "GIL mutex deadlock",
    14: "shutdown hangs traceback",
    15: "see what happens call",
}
"""What a user with each of the known pains types into the search box."""

FEW = 16
"""A search that finds more pages than these does not help."""


class Search:
    """Finds the pages that have all words, as the site's search box does."""

    def __init__(self, site: Path) -> None:
        script = (site / "searchindex.js").read_text()
        self._index: dict[str, Any] = json.loads(
            script.removeprefix("Search.setIndex(").rstrip().removesuffix(")")
        )
        self._language = SearchEnglish({})

    def pages(self, query: str) -> set[str]:
        """Return the names of the pages."""
        words = [word.lower() for word in query.split()]
        found = [
            self._with(self._language.stem(word))
            for word in words
            if self._language.word_filter(word)
        ]
        return {self._index["docnames"][number] for number in set.intersection(*found)}

    def _with(self, stem: str) -> set[int]:
        pages: set[int] = set()
        for terms in (self._index["terms"], self._index["titleterms"]):
            numbers = terms.get(stem, [])
            pages |= {numbers} if isinstance(numbers, int) else set(numbers)
        return pages


def test_the_site(tmp_path: Path) -> None:
    build = (sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "docs", str(tmp_path))
    done = subprocess.run(build, cwd=ROOT, stderr=subprocess.PIPE, text=True, timeout=300)
    assert done.returncode == 0, done.stderr

    search = Search(tmp_path)
    hits = {query: search.pages(query) for query in PAINS.values()}
    assert not {q: sorted(h) for q, h in hits.items() if "troubleshooting" not in h}
    assert not {q: len(h) for q, h in hits.items() if len(h) > FEW}

    tutorial = (tmp_path / "tutorial.html").read_text()
    assert 'href="reference/session.html#rosasync.Session.call"' in tutorial
    docstring = (tmp_path / "reference" / "session.html").read_text()
    assert 'href="pool.html#rosasync.Limits.waiting"' in docstring
    pages = [page.read_text() for page in tmp_path.rglob("*.html")]
    assert not [page for page in pages if re.search(r"--8&lt;--|^<p>::: ", page, re.MULTILINE)]
