"""The pytest plugin under its old name; pytest loads ``pytest_rosasync`` by itself."""

from __future__ import annotations

from pytest_rosasync import fake_graph, ros_domain

__all__ = ["fake_graph", "ros_domain"]

pytest_plugins = ["pytest_rosasync"]
