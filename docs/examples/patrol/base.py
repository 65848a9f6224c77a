"""The base of a robot, in plain rclpy: its drives take a second, its battery lasts for two."""

import time

import rclpy
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.node import Node
from std_srvs.srv import Trigger


class Base(Node):
    def __init__(self) -> None:
        super().__init__("base")
        group = ReentrantCallbackGroup()
        self.drives = 0
        for name, callback in {
            "/base/go_to_door": self.drive,
            "/base/go_to_window": self.drive,
            "/base/dock": self.drive,
            "/battery/is_low": self.is_low,
        }.items():
            self.create_service(Trigger, name, callback, callback_group=group)

    def drive(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self.drives += 1
        time.sleep(1.0)
        response.success = True
        return response

    def is_low(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success = self.drives >= 3
        return response


def main() -> None:
    rclpy.init()
    node = Base()
    try:
        rclpy.spin(node, MultiThreadedExecutor(num_threads=4))
    except (KeyboardInterrupt, ExternalShutdownException):
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
