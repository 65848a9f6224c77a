"""A lamp in plain rclpy: the service ``/lamp/switch``, of type ``std_srvs/srv/SetBool``."""

import rclpy
from rclpy.executors import ExternalShutdownException
from std_srvs.srv import SetBool


def switch(request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
    response.success = True
    response.message = "on" if request.data else "off"
    return response


def main() -> None:
    rclpy.init()
    node = rclpy.create_node("lamp")
    node.create_service(SetBool, "/lamp/switch", switch)
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
