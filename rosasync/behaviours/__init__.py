"""Behaviours for py_trees that call services without ever blocking a tick (extra ``py-trees``).

Ticked in the loop, with an ``await`` between ticks, or in a thread of the tree's own, with
``tree.tick_tock``::

    root = py_trees.composites.Sequence("fetch", memory=True, children=[
        WaitForService("arm there?", SetBool, "/arm/enable", timeout=5.0),
        CallService("enable arm", SetBool, "/arm/enable", {"data": True}, timeout=2.0),
    ])
    tree = py_trees.trees.BehaviourTree(root)
    tree.setup(session=session)
"""

from __future__ import annotations

from rosasync.behaviours._goals import SendGoal
from rosasync.behaviours._services import (
    CallService,
    FromBlackboard,
    FromConstant,
    WaitForService,
)

__all__ = ["CallService", "FromBlackboard", "FromConstant", "SendGoal", "WaitForService"]
