"""A user's project that has rosasync installed: its metadata, which names the pytest plugin."""

from __future__ import annotations

import os
from pathlib import Path

from tests.support.process import ROOT

__all__ = ["PLUGIN", "python_path"]

PLUGIN = "rosasync.testing.plugin"


def python_path(folder: Path) -> str:
    """Write the metadata to a folder; return the ``PYTHONPATH`` that makes pytest find it."""
    info = folder / "rosasync-0.1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: rosasync\nVersion: 0.1.0\n")
    (info / "entry_points.txt").write_text(f"[pytest11]\n{PLUGIN} = {PLUGIN}\n")
    return os.pathsep.join([str(folder), str(ROOT)])
