"""The middlewares that are installed. It runs before rclpy is imported, so it imports none."""

from __future__ import annotations

import ctypes
import importlib.util
import os
import sys
from pathlib import Path

__all__ = ["check_middleware", "installed_middlewares", "prefixes"]

VARIABLE = "RMW_IMPLEMENTATION"


def check_middleware() -> None:
    """Check that the middleware named by ``RMW_IMPLEMENTATION`` can be loaded.

    If it cannot, rclpy ends the process at its import, without a Python exception. So call this
    before rclpy is imported.

    Raises:
        ImportError: it cannot be loaded; the message says which middlewares are installed.
    """
    wanted = os.environ.get(VARIABLE)
    if not wanted or sys.platform != "linux" or "rclpy" in sys.modules:
        return
    if importlib.util.find_spec("rclpy") is None:
        return
    try:
        ctypes.CDLL(f"lib{wanted}.so")
    except OSError as error:
        found = ", ".join(installed_middlewares()) or "none"
        raise ImportError(
            f"{VARIABLE}={wanted}, but this middleware cannot be loaded ({error}). Installed: "
            f"{found}. Set {VARIABLE} to one of these, unset it, or install {wanted}"
        ) from None


def installed_middlewares() -> list[str]:
    """Return the names of the installed middlewares."""
    names = {
        entry.name
        for prefix in prefixes()
        for entry in (prefix / "share/ament_index/resource_index/rmw_typesupport").glob("rmw_*")
    }
    return sorted(names - {"rmw_implementation"})


def prefixes() -> list[Path]:
    """Return the folders in which ROS packages are installed, the first ones preferred."""
    sourced = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    return [Path(folder) for folder in (*sourced, sys.prefix) if folder]
