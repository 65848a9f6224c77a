"""A dashboard of a node's services: ``python dashboard.py /robot``.

Enter calls the selected service with an empty request, and shows its answer.
"""

import asyncio
import sys
import time
from typing import ClassVar

from rclpy.node import NodeNameNonExistentError
from rich.text import Text
from textual.app import App, ComposeResult
from textual.widgets import DataTable, Footer, Header

import rosasync

HIDDEN = ("rcl_interfaces/", "type_description_interfaces/")
"""The packages of the services that every node has."""


class Dashboard(App[None]):
    BINDINGS: ClassVar = [("q", "quit", "Quit")]

    def __init__(self, session: rosasync.Session, node: str, period: float = 1.0) -> None:
        super().__init__()
        self.session = session
        self.title = f"the services of {node}"
        self.namespace, _, self.node_name = node.rpartition("/")
        self.period = period
        self.table: DataTable[Text] = DataTable(cursor_type="row")

    def compose(self) -> ComposeResult:
        yield Header()
        yield self.table
        yield Footer()

    def on_mount(self) -> None:
        for column in ("service", "type", "ms", "answer"):
            self.table.add_column(column, key=column)
        self.show_services()
        self.set_interval(self.period, self.show_services)

    def services(self) -> dict[str, str]:
        """Return the type of each service of the node, in the order of their names."""
        node = self.session.node
        try:
            found = node.get_service_names_and_types_by_node(self.node_name, self.namespace or "/")
        except NodeNameNonExistentError:
            return {}
        return {name: types[0] for name, types in sorted(found) if not types[0].startswith(HIDDEN)}

    def show_services(self) -> None:
        """Add the services that are new, and remove those that are gone."""
        services = self.services()
        for key in [key for key in self.table.rows if key.value not in services]:
            self.table.remove_row(key)
        for name, srv_type in services.items():
            if name not in self.table.rows:
                self.table.add_row(Text(name), Text(srv_type), Text(), Text(), key=name)
        self.table.sort("service", key=str)

    def on_data_table_row_selected(self, event: DataTable.RowSelected) -> None:
        # A worker is a task of the app: the dashboard goes on while the call waits.
        self.run_worker(self.call(str(event.row_key.value)))

    async def call(self, name: str) -> None:
        srv_type = self.table.get_cell(name, "type").plain
        self.show(name, "", "…")
        started = time.perf_counter()
        try:
            response = await self.session.call(srv_type, name)
            answer = str(rosasync.to_dict(response))
        except (rosasync.RosasyncError, ValueError) as error:
            answer = f"{type(error).__name__}: {error}"
        self.show(name, f"{1000 * (time.perf_counter() - started):.1f}", answer)

    def show(self, name: str, milliseconds: str, answer: str) -> None:
        if name in self.table.rows:
            self.table.update_cell(name, "ms", Text(milliseconds))
            self.table.update_cell(name, "answer", Text(answer), update_width=True)


async def main(node: str) -> None:
    async with rosasync.Session("dashboard", timeout=2.0) as session:
        await Dashboard(session, node).run_async()


if __name__ == "__main__":
    asyncio.run(main(sys.argv[1]))
