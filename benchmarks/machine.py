"""The machine and the versions to which a result belongs."""

from __future__ import annotations

import importlib.metadata
import os
import platform
from pathlib import Path
from typing import Any

__all__ = ["describe_machine"]

PACKAGES = (
    "rosasync",
    "rclpy",
    "ros-rmw-fastrtps-cpp",
    "ros-fastrtps",
    "ros-fastdds",
    "asyncio-for-robotics",
    "uvloop",
    "anyio",
    "py_trees",
)


def describe_machine() -> dict[str, Any]:
    """Describe the hardware, its load, the system, and the versions of all contestants."""
    from rclpy.utilities import get_rmw_implementation_identifier

    return {
        "cpu": _cpu_model(),
        "cores": len(os.sched_getaffinity(0)),
        "load": os.getloadavg()[0],
        "kernel": platform.release(),
        "python": platform.python_version(),
        "middleware": get_rmw_implementation_identifier(),
        "versions": {name: version for name in PACKAGES if (version := _version(name))},
    }


def _cpu_model() -> str:
    for line in Path("/proc/cpuinfo").read_text().splitlines():
        if line.startswith("model name"):
            return line.partition(":")[2].strip()
    return platform.machine()


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None
