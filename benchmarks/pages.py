"""Pages with sections that commands write: each stands between two marks."""

from __future__ import annotations

import re

__all__ = ["markdown_table", "marked_sections", "replace_section"]

SECTION = re.compile(r"<!-- ([\w-]+) -->\n.*?<!-- /\1 -->\n", re.DOTALL)


def replace_section(page: str, name: str, text: str) -> str:
    """Return a page with `text` between the marks of this name.

    Raises:
        ValueError: the page does not have the marks.
    """
    begin, end = f"<!-- {name} -->\n", f"<!-- /{name} -->\n"
    before, found, rest = page.partition(begin)
    _, closed, after = rest.partition(end)
    if not (found and closed):
        raise ValueError(f"the page has no {begin.strip()} … {end.strip()}")
    return f"{before}{begin}{text}{end}{after}"


def marked_sections(page: str) -> list[str]:
    """Return every section with its marks, in their order."""
    return [match[0] for match in SECTION.finditer(page)]


def markdown_table(heading: list[str], body: list[list[str]]) -> str:
    """Return a table in Markdown."""
    lines = [heading, ["---"] * len(heading), *body]
    cells = ([cell.replace("|", "\\|") for cell in line] for line in lines)
    return "\n".join(f"| {' | '.join(line)} |" for line in cells) + "\n"
