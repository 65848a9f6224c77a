"""The mission as a py_trees tree, for the two examples that tick it."""

from typing import Any

from py_trees.behaviour import Behaviour
from py_trees.common import ParallelPolicy
from py_trees.composites import Parallel, Selector, Sequence
from std_srvs.srv import SetBool, Trigger

from rosasync.behaviours import CallService, WaitForService


def show(response: Any) -> None:
    print(response.message)


def call(srv_type: Any, srv_name: str, **fields: Any) -> Behaviour:
    return CallService(srv_name, srv_type, srv_name, fields, on_response=show, timeout=5.0)


def make_mission() -> Behaviour:
    door = [call(Trigger, "/door/open"), call(Trigger, "/door/knock")]
    at_once = [
        call(Trigger, "/gripper/open"),
        call(SetBool, "/lamp/switch", data=True),
        call(SetBool, "/camera/enable", data=True),
    ]
    steps = [
        WaitForService("robot there?", SetBool, "/arm/enable", timeout=20.0),
        call(SetBool, "/arm/enable", data=True),
        call(Trigger, "/arm/home"),
        Selector("door", memory=True, children=door),
        Parallel("at once", ParallelPolicy.SuccessOnAll(), at_once),
        call(Trigger, "/map/save"),
    ]
    return Sequence("mission", memory=True, children=steps)
