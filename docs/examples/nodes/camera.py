"""A camera in plain rclpy: the lifecycle node ``/camera``, which takes two seconds to configure."""

import time

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn


class Camera(LifecycleNode):
    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        time.sleep(2.0)
        return TransitionCallbackReturn.SUCCESS


def main() -> None:
    rclpy.init()
    node = Camera("camera")
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
