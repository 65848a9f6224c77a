"""The configuration of the documentation: Sphinx, with pages in MyST Markdown.

Build it with ``sphinx-build -W docs site``.
"""

from __future__ import annotations

import re
from importlib import metadata
from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx import addnodes
from sphinx.application import Sphinx
from sphinx.transforms import SphinxTransform

import rosasync

project = "rosasync"
author = "The rosasync authors"
project_copyright = author
release = version = metadata.version("rosasync")

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx_copybutton",
]
exclude_patterns = ["site"]

html_theme = "furo"
html_title = f"rosasync {release}"
html_copy_source = False
html_static_path = ["_static"]
html_css_files = ["narrow.css"]

myst_heading_anchors = 3

autodoc_default_options = {"members": True, "member-order": "bysource"}
autodoc_preserve_defaults = True
autodoc_typehints_format = "short"
napoleon_google_docstring = True
napoleon_numpy_docstring = False
python_maximum_signature_line_length = 88
toc_object_entries_show_parents = "hide"
# A name in single backquotes in a docstring links to its entry.
default_role = "py:obj"

copybutton_prompt_text = "$ "
copybutton_only_copy_prompt_lines = True

HANDLES = {
    "session": "Session",
    "session.pool": "ClientPool",
    "session.from_thread": "Portal",
    "server": "ServiceServer",
    "call": "ServiceCall",
    "proxy": "AsyncServiceProxy",
}
"""What the pages call an object, and its class."""


OBTAINED = ("ClientPool", "LeasedClient", "Portal", "ServiceCall", "ServiceClient", "ServiceServer")
"""Classes that only a session constructs, so their arguments are not shown."""

SUBJECTS = {
    "how-to/callbacks": ["callback", "deadlock", "subscription", "timer"],
    "how-to/deploy": ["docker", "graceful shutdown", "launch file", "sigterm", "systemd"],
    "how-to/domains": ["domain", "namespace", "ROS_DOMAIN_ID"],
    "how-to/errors": ["cancel", "deadline", "error handling", "exceptions", "timeout", "warm up"],
    "how-to/fastapi": ["fastapi", "http", "json", "rest api", "web"],
    "how-to/from-rclpy": ["call_async", "migrate", "porting", "rclpy"],
    "how-to/install": ["aarch64", "arm", "conda", "install", "pip", "robostack", "rosdep"],
    "how-to/lifecycle": ["lifecycle", "managed nodes", "transition"],
    "how-to/logging": ["debug", "log", "logging", "metrics", "opentelemetry", "tracing"],
    "how-to/loops": ["anyio", "event loop", "uvloop"],
    "how-to/middleware": ["cyclonedds", "middleware", "zenoh"],
    "how-to/network": ["discovery", "packet loss", "wifi"],
    "how-to/node": ["await a future", "borrow a node", "existing node", "wrap_future"],
    "how-to/notebook": ["ipython", "jupyter", "notebook"],
    "how-to/own-types": ["colcon", "custom srv", "own types"],
    "how-to/parameters": ["param", "parameters", "yaml"],
    "how-to/pool": ["client pool", "concurrency limit", "limits", "pool"],
    "how-to/qt": ["gui", "pyqt", "pyside", "qt"],
    "how-to/retry": ["at least once", "resend", "retry"],
    "how-to/servers": ["deferred response", "server", "service server"],
    "how-to/testing": ["fixture", "mock", "pytest", "simulate", "test", "unit test"],
    "how-to/ticks": ["behavior tree", "behavior trees", "behaviour tree", "py_trees", "thread"],
    "how-to/typing": ["mypy", "pyright", "type hints"],
}
"""What people type into the search box, and the page that is about it. The search finds an entry of
the index before everything else."""


class SubjectsInIndex(SphinxTransform):
    """Enter the subjects of a page into the index."""

    default_priority = 500

    def apply(self, **kwargs: Any) -> None:
        """Put an index node with the page's subjects before its text."""
        entries = [
            ("single", subject, "", "main", None) for subject in SUBJECTS.get(self.env.docname, ())
        ]
        if entries:
            self.document.insert(0, addnodes.index(entries=entries))


WIDE = 500
"""The width in pixels up to which a picture is readable on a phone."""


class WidePictures(SphinxTransform):
    """Mark the pictures that a phone has to scroll, for `narrow.css`."""

    default_priority = 100  # while the uri is still that of the page

    def apply(self, **kwargs: Any) -> None:
        """Read the width of each picture from its file."""
        folder = Path(self.document["source"]).parent
        for image in self.document.findall(nodes.image):
            width = re.search(r'<svg[^>]* width="([\d.]+)', (folder / image["uri"]).read_text())
            if width and float(width[1]) > WIDE:
                image["classes"].append("wide")


class NamesToReferences(SphinxTransform):
    """Link the names in the pages' code spans, such as `session.call`, to the reference."""

    default_priority = 500

    def apply(self, **kwargs: Any) -> None:
        """Wrap each code span that names something public into a reference to it."""
        for literal in list(self.document.findall(nodes.literal)):
            target = target_of(literal.astext())
            if target is None or _is_linked(literal):
                continue
            reference = addnodes.pending_xref(
                "", refdomain="py", reftype="obj", reftarget=target, refdoc=self.env.docname
            )
            literal.replace_self(reference)
            reference += literal


def target_of(code: str) -> str | None:
    """Return the full name of what a code span means, or None if it is not a public name."""
    name = re.sub(r"\(.*\)$", "", code, flags=re.DOTALL).removeprefix("await ")
    owner, _, member = name.rpartition(".")
    if owner in HANDLES and member != "py":
        return f"rosasync.{HANDLES[owner]}.{member}"
    name = name.removeprefix("rosasync.")
    return f"rosasync.{name}" if name.partition(".")[0] in rosasync.__all__ else None


def _is_linked(node: nodes.Node) -> bool:
    inside: Any = node.parent
    while inside is not None:
        if isinstance(inside, nodes.title | nodes.reference | addnodes.pending_xref):
            return True
        if isinstance(inside, addnodes.desc):
            return True
        inside = inside.parent
    return False


def _hide_arguments(
    app: Sphinx, what: str, name: str, obj: Any, options: Any, signature: str, returns: str
) -> tuple[str, str] | None:
    obtained = what == "class" and name.rpartition(".")[2] in OBTAINED
    return ("", "") if obtained else None


def _skip_private(
    app: Sphinx, what: str, name: str, obj: Any, skip: bool, options: Any
) -> bool | None:
    return True if "Not part of the public API" in (obj.__doc__ or "") else None


def setup(app: Sphinx) -> None:
    """Register the transforms and the two filters of the reference."""
    app.add_transform(SubjectsInIndex)
    app.add_transform(WidePictures)
    app.add_transform(NamesToReferences)
    app.connect("autodoc-process-signature", _hide_arguments)
    app.connect("autodoc-skip-member", _skip_private)
