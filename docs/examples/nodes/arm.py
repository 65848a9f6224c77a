"""An arm in plain rclpy: the node ``/arm`` with parameters."""

import rclpy
from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor
from rclpy.executors import ExternalShutdownException


def main() -> None:
    rclpy.init()
    node = rclpy.create_node("arm")
    limits = FloatingPointRange(from_value=0.0, to_value=1.0)
    speed = ParameterDescriptor(description="m/s", floating_point_range=[limits])
    node.declare_parameter("speed", 0.5, speed)
    node.declare_parameter("home", [0.0, 0.0, 0.5])
    node.declare_parameter("serial", "A1", ParameterDescriptor(read_only=True))
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
