"""A stock node with the introspection parameter of ROS's demo nodes, and a stock caller of it.

``python -m tests.support.introspected``
"""

from __future__ import annotations

import threading
from typing import Any

from tests.support.child import serve_commands
from tests.support.process import NodeProcess

__all__ = ["NAME", "PARAMETER", "IntrospectedProcess"]

NAME = "/watched/switch"
PARAMETER = "service_configure_introspection"


class IntrospectedProcess(NodeProcess):
    """The parent's side of one such process."""

    module = "tests.support.introspected"

    def call(self, data: bool) -> None:
        """Make a call with the process's own stock client."""
        self.ask_now("call", data=data)

    @property
    def listeners(self) -> int:
        """How many subscriptions to the events of the service its node has discovered."""
        return int(self.ask_now("listeners"))

    @property
    def setting(self) -> str:
        """The value of the parameter."""
        return str(self.ask_now("setting"))


def main() -> None:
    import rclpy
    from rcl_interfaces.msg import SetParametersResult
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.qos import qos_profile_system_default
    from rclpy.service_introspection import ServiceIntrospectionState
    from rclpy.signals import SignalHandlerOptions
    from std_srvs.srv import SetBool

    states = {
        "disabled": ServiceIntrospectionState.OFF,
        "metadata": ServiceIntrospectionState.METADATA,
        "contents": ServiceIntrospectionState.CONTENTS,
    }
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node("watched")

    def switch(request: Any, response: Any) -> Any:
        response.success = request.data
        return response

    service = node.create_service(SetBool, NAME, switch)
    client = node.create_client(SetBool, NAME)
    node.declare_parameter(PARAMETER, "disabled")

    def configure(parameters: Any) -> Any:
        for parameter in parameters:
            if parameter.name == PARAMETER:
                state = states[parameter.value]
                service.configure_introspection(node.get_clock(), qos_profile_system_default, state)
        return SetParametersResult(successful=True)

    node.add_on_set_parameters_callback(configure)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    spinner = threading.Thread(target=executor.spin)
    spinner.start()

    def call(data: bool) -> None:
        client.call(SetBool.Request(data=data))

    serve_commands(
        {
            "call": call,
            "listeners": lambda: node.count_subscribers(f"{NAME}/_service_event"),
            "setting": lambda: node.get_parameter(PARAMETER).value,
        }
    )
    executor.shutdown()
    spinner.join()
    node.destroy_node()
    rclpy.shutdown()


if __name__ == "__main__":
    main()
