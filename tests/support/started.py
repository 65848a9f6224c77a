"""A process of stock nodes started with ``--params-file``: ``python -m tests.support.started``."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

from tests.support.child import serve_commands
from tests.support.process import NodeProcess

__all__ = ["NAME", "Refused", "StartedProcess", "typed"]

NAME = "/stock/started"


class Refused(Exception):
    """A node does not start with a file; the message says why."""


def typed(values: dict[str, Any]) -> dict[str, Any]:
    """Return values in a form that tells 1 from 1.0 and True, and has NaN equal to itself."""
    return {name: repr(value) for name, value in values.items()}


class StartedProcess(NodeProcess):
    """The parent's side of one such process."""

    module = "tests.support.started"

    def start(self, file: bytes) -> dict[str, Any]:
        """Start a node named `NAME` with this file, and return its parameters, `typed`.

        Raises:
            Refused: the node did not start.
        """
        with tempfile.NamedTemporaryFile(suffix=".yaml") as written:
            Path(written.name).write_bytes(file)
            answer: dict[str, Any] = self.ask_now("start", file=written.name)
        if "refused" in answer:
            raise Refused(answer["refused"])
        return answer


def _start(file: str) -> dict[str, Any]:
    import rclpy
    from rclpy._rclpy_pybind11 import RCLInvalidROSArgsError

    namespace, _, name = NAME.rpartition("/")
    try:
        node = rclpy.create_node(
            name,
            namespace=namespace,
            cli_args=["--ros-args", "--params-file", file],
            enable_rosout=False,
            start_parameter_services=False,
            allow_undeclared_parameters=True,
            automatically_declare_parameters_from_overrides=True,
        )
    except (RCLInvalidROSArgsError, ValueError) as error:
        return {"refused": str(error)}
    try:
        found = {name: parameter.value for name, parameter in node._parameters.items()}
    finally:
        node.destroy_node()
    found.pop("use_sim_time", None)
    found.pop("start_type_description_service", None)
    # Arrays of numbers are no lists there.
    return typed(
        {name: list(value) if hasattr(value, "tolist") else value for name, value in found.items()}
    )


def main() -> None:
    import rclpy
    from rclpy.signals import SignalHandlerOptions

    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    serve_commands({"start": _start})
    rclpy.shutdown()


if __name__ == "__main__":
    main()
