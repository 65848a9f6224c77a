"""A robot with a dozen services, in plain rclpy.

The examples run this mission: enable the arm and move it home. Open the door, or knock if it is
locked. Open the gripper, switch the lamp on and start the camera, all at once. Save the map.
"""

from functools import partial
from typing import Any

import rclpy
from rclpy.executors import ExternalShutdownException
from std_srvs.srv import SetBool, Trigger

SERVICES = {
    "/arm/enable": (SetBool, True, "the arm is enabled"),
    "/arm/home": (Trigger, True, "the arm is home"),
    "/base/dock": (Trigger, True, "the base is docked"),
    "/base/enable": (SetBool, True, "the base is enabled"),
    "/camera/enable": (SetBool, True, "the camera runs"),
    "/door/knock": (Trigger, True, "somebody opened the door"),
    "/door/open": (Trigger, False, "the door is locked"),
    "/gripper/close": (Trigger, True, "the gripper is closed"),
    "/gripper/open": (Trigger, True, "the gripper is open"),
    "/lamp/switch": (SetBool, True, "the lamp is on"),
    "/map/load": (Trigger, True, "the map is loaded"),
    "/map/save": (Trigger, True, "the map is saved"),
}


def answer(success: bool, message: str, request: Any, response: Any) -> Any:
    response.success = success
    response.message = message
    return response


def main() -> None:
    rclpy.init()
    node = rclpy.create_node("robot")
    for name, (srv_type, success, message) in SERVICES.items():
        node.create_service(srv_type, name, partial(answer, success, message))
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
