"""The site of the documentation: built without a warning, linked to the reference, searchable."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import pytest
from sphinx.search.en import SearchEnglish

from tests.support.process import ROOT

PAINS = {
    "A call hangs": [
        "client call hangs",
        "call stuck",
        "call_async never returns",
        "second call hanging forever",
        "call blocks forever timeout",
    ],
    "Deadlock": [
        "deadlock callback",
        "call service inside callback",
        "spin_until_future_complete callback",
        "MultiThreadedExecutor callback group deadlock",
    ],
    "`await`": ["Task got bad yield", "await call_async asyncio", "await rclpy future"],
    "The first call": [
        "first response lost",
        "wait_for_service true response lost",
        "client will not receive response",
    ],
    "Memory grows": ["memory leak", "remove_pending_request", "pending requests leak timeout"],
    "Crash": ["segfault destroy_client", "InvalidHandle", "crash destroying clients spinning"],
    "A client for each call": [
        "create_client slow",
        "behavior tree slow loading",
        "many clients slow",
        "client per call",
    ],
    "Requests are silently dropped": [
        "dropped requests load",
        "requests lost queue",
        "missing responses",
        "too many requests",
    ],
    "A service is not found": [
        "service not available, waiting again",
        "service not found",
        "wait_for_service never returns",
        "ros2 service list",
    ],
    "A server handles one": [
        "exception service callback node dies",
        "server handles one request at a time",
        "parallel requests server",
        "concurrent service callbacks",
    ],
    "Behaviour tree ticks": [
        "behavior tree blocking tick",
        "py_trees service call",
        "halt stale result",
        "tree stuck",
    ],
    "High CPU": ["100% CPU executor", "high CPU usage", "idle node CPU"],
    "The program freezes": ["GIL deadlock", "program freezes", "EventsExecutor hangs"],
    "Shutdown hangs": [
        "ctrl-c traceback",
        "ExternalShutdownException",
        "shutdown hangs",
        "KeyboardInterrupt",
        "SIGTERM",
    ],
    "I cannot see": [
        "debug service call",
        "log every call",
        "monitor calls statistics",
        "ros2 service echo",
    ],
}
"""The section of the page *Troubleshooting* for each of the fifteen known pains, by the beginning
of its title, and what users type into a search box: words of the questions and issues about it."""

FIRST = {
    "behavior trees": "how-to/ticks",
    "cancel": "how-to/errors",
    "conda": "how-to/install",
    "deadline": "how-to/errors",
    "deadlock": "how-to/callbacks",
    "docker": "how-to/deploy",
    "graceful shutdown": "how-to/deploy",
    "jupyter": "how-to/notebook",
    "launch file": "how-to/deploy",
    "lifecycle": "how-to/lifecycle",
    "mock": "how-to/testing",
    "mypy": "how-to/typing",
    "opentelemetry": "how-to/logging",
    "packet loss": "how-to/network",
    "parameters": "how-to/parameters",
    "pool": "how-to/pool",
    "pytest": "how-to/testing",
    "retry": "how-to/retry",
    "server": "how-to/servers",
    "timeout": "how-to/errors",
    "uvloop": "how-to/loops",
    "zenoh": "how-to/middleware",
}
"""What is searched for, and the page that has to come first."""

WIDE = {"benchmarks.html": True, "explanation/index.html": True, "index.html": False}
"""Whether a page has pictures that are scrolled on a phone."""

FEW = 20
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
        found = map(self._with, self.stems(query))
        return {self._index["docnames"][number] for number in set.intersection(*found)}

    def first(self, query: str) -> str | None:
        """Return the page that comes first: that of a main entry of the index.

        Such an entry scores 100 times the share of it that the query is, and all else 31 at most
        (Sphinx's searchtools.js). None if no page stands out like that.
        """
        scores: dict[int, float] = {}
        for entry, found in self._index["indexentries"].items():
            if query in entry and len(query) >= len(entry) / 2:
                score = round(100 * len(query) / len(entry))
                for number, _, main in found:
                    if main:
                        scores[number] = max(score, scores.get(number, 0))
        best = max(scores.values(), default=0)
        pages = [self._index["docnames"][n] for n, score in scores.items() if score == best > 31]
        return pages[0] if len(pages) == 1 else None

    def stems(self, text: str) -> set[str]:
        """Return what counts of the words of a text."""
        words = [word.lower() for word in self._language.split(text)]
        return {self._language.stem(word) for word in words if self._language.word_filter(word)}

    def _with(self, stem: str) -> set[int]:
        pages: set[int] = set()
        for terms in (self._index["terms"], self._index["titleterms"]):
            numbers = terms.get(stem, [])
            pages |= {numbers} if isinstance(numbers, int) else set(numbers)
        return pages


class Page(HTMLParser):
    """What can be linked to in a page of the site, and what the page links to."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.anchors: set[str] = set()
        self.links: set[str] = set()
        self.feed(path.read_text())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            if name == "id" and value:
                self.anchors.add(value)
            elif name in ("href", "src") and value and not urlsplit(value).scheme:
                self.links.add(value)


def dead_links(site: Path) -> list[str]:
    """Return the links within the site that lead to no file, or to no anchor of a page."""
    pages = {path: Page(path) for path in site.rglob("*.html")}
    dead = []
    for path, page in pages.items():
        for link in page.links:
            url = urlsplit(link)
            target = (path.parent / unquote(url.path)).resolve() if url.path else path
            anchors = pages[target].anchors if target in pages else set()
            if not target.exists() or (url.fragment and unquote(url.fragment) not in anchors):
                dead.append(f"{path.relative_to(site)}: {link}")
    return sorted(dead)


def section_of(page: str, title: str) -> str:
    """Return the one section of a page whose title begins so."""
    text = (ROOT / "docs" / f"{page}.md").read_text()
    (section,) = [part for part in text.split("\n## ")[1:] if part.startswith(title)]
    return section


@pytest.mark.slow
def test_the_site(tmp_path: Path) -> None:
    build = (sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "docs", str(tmp_path))
    done = subprocess.run(build, cwd=ROOT, stderr=subprocess.PIPE, text=True, timeout=300)
    assert done.returncode == 0, done.stderr

    assert dead_links(tmp_path) == []

    search = Search(tmp_path)
    assert len(PAINS) == 15
    hits = {query: search.pages(query) for queries in PAINS.values() for query in queries}
    assert not {q: sorted(h) for q, h in hits.items() if "troubleshooting" not in h}
    assert not {q: len(h) for q, h in hits.items() if len(h) > FEW}
    for title, queries in PAINS.items():
        section = search.stems(section_of("troubleshooting", title))
        assert not {q: search.stems(q) - section for q in queries if search.stems(q) - section}

    assert {query: search.first(query) for query in FIRST} == FIRST

    assert "_static/narrow.css" in (tmp_path / "index.html").read_text()
    assert "img.wide" in (tmp_path / "_static" / "narrow.css").read_text()
    wide = {page: 'class="wide"' in (tmp_path / page).read_text() for page in WIDE}
    assert wide == WIDE

    tutorial = (tmp_path / "tutorial.html").read_text()
    assert 'href="reference/session.html#rosasync.Session.call"' in tutorial
    docstring = (tmp_path / "reference" / "session.html").read_text()
    assert 'href="pool.html#rosasync.Limits.waiting"' in docstring
    pages = [page.read_text() for page in tmp_path.rglob("*.html")]
    assert not [page for page in pages if re.search(r"--8&lt;--|^<p>::: ", page, re.MULTILINE)]


def test_dead_links_are_found(tmp_path: Path) -> None:
    (tmp_path / "one.html").write_text(
        '<h1 id="top">One</h1> <a href="two.html#here">a</a> <a href="two.html#there">b</a>'
        '<a href="#top">c</a> <a href="three.html">d</a> <a href="https://ros.org/#x">e</a>'
    )
    (tmp_path / "two.html").write_text('<p id="here"></p>')
    assert dead_links(tmp_path) == ["one.html: three.html", "one.html: two.html#there"]
