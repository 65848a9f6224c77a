"""The dashboard, driven by Textual's pilot, with the services of a test on real ROS."""

import asyncio
from collections.abc import Callable

import pytest
from dashboard import Dashboard
from std_srvs.srv import SetBool, Trigger
from textual.pilot import Pilot

from rosasync.testing import Graph

pytestmark = [
    pytest.mark.asyncio,
    pytest.mark.parametrize("ros_graph", ["real"], indirect=True),
]


async def until(pilot: Pilot[None], condition: Callable[[], object]) -> None:
    async with asyncio.timeout(20.0):
        while not condition():
            await pilot.pause(0.05)


async def test_the_services_of_a_node(ros_graph: Graph) -> None:
    switch = ros_graph.stub(SetBool, "/lamp/switch", {"success": True, "message": "off"})
    blink = ros_graph.stub(Trigger, "/lamp/blink", {"success": False, "message": "[broken]"})

    async with ros_graph.session(timeout=4.0) as session:
        app = Dashboard(session, "/stubs", period=0.05)

        def cells(column: str) -> list[str]:
            return [cell.plain for cell in app.table.get_column(column)]

        async with app.run_test() as pilot:
            await until(pilot, lambda: len(cells("service")) == 2)
            assert cells("service") == ["/lamp/blink", "/lamp/switch"]
            assert cells("type") == ["std_srvs/srv/Trigger", "std_srvs/srv/SetBool"]

            await pilot.press("enter", "down", "enter")
            await until(pilot, lambda: all(cells("ms")))
            assert cells("answer") == [
                "{'success': False, 'message': '[broken]'}",
                "{'success': True, 'message': 'off'}",
            ]
            switch.assert_requests({"data": False})

            await blink.vanish()
            await until(pilot, lambda: cells("service") == ["/lamp/switch"])
            await blink.come_back()
            await until(pilot, lambda: cells("service") == ["/lamp/blink", "/lamp/switch"])

            app.table.move_cursor(row=1)
            with switch.drop_responses():
                await pilot.press("enter")
                await until(pilot, lambda: "ResponseTimeout" in cells("answer")[1])
