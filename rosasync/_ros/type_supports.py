"""Loads the type supports of the topics and services that every node has.

rclpy loads them when a process creates its first node, on the thread that creates it.
"""

from __future__ import annotations

from rcl_interfaces.msg import ParameterEvent
from rcl_interfaces.srv import GetParameters
from rclpy.type_support import check_for_type_support
from type_description_interfaces.srv import GetTypeDescription

__all__ = ["load"]


def load() -> None:
    """Load them. Blocks for some tens of milliseconds the first time. From any thread."""
    for one_of_its_package in (ParameterEvent, GetParameters, GetTypeDescription):
        check_for_type_support(one_of_its_package)
