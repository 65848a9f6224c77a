"""The application, called by httpx as by 300 browsers: in memory, and on real ROS."""

import asyncio
import itertools
from collections.abc import AsyncIterator

import httpx
import pytest
import pytest_asyncio
from app import LAMP, create_app
from std_srvs.srv import SetBool

from rosasync.testing import Graph, VirtualClock

pytestmark = [
    pytest.mark.asyncio,
    pytest.mark.parametrize("ros_graph", ["memory", "real"], indirect=True),
]


@pytest_asyncio.fixture
async def browser(ros_graph: Graph) -> AsyncIterator[httpx.AsyncClient]:
    app = create_app(ros_graph.session("web"))
    transport = httpx.ASGITransport(app)
    # httpx does not run the lifespan of an application.
    async with (
        app.router.lifespan_context(app),
        httpx.AsyncClient(transport=transport, base_url="http://robot") as client,
    ):
        yield client


async def test_300_requests_at_once(ros_graph: Graph, browser: httpx.AsyncClient) -> None:
    numbers = itertools.count(1)

    async def count(request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        await asyncio.sleep(0.001)
        response.message = str(next(numbers))
        return response

    lamp = ros_graph.serve(SetBool, LAMP, count)
    answers = await asyncio.gather(*(browser.post("/lamp/true") for _ in range(300)))

    assert {answer.status_code for answer in answers} == {200}
    assert sorted(int(answer.json()["lamp"]) for answer in answers) == list(range(1, 301))
    lamp.assert_called(times=300)
    calls = {"waiting": 0, "completed": 300}
    assert (await browser.get("/health")).json() == {"lamp": True, "calls": calls}


@pytest.mark.rosasync(strict=False)
async def test_a_lamp_that_is_not_there(
    browser: httpx.AsyncClient, virtual_clock: VirtualClock
) -> None:
    answer = await virtual_clock.skip(browser.post("/lamp/true"))
    assert answer.status_code == 503
    assert LAMP in answer.json()["detail"]


async def test_a_lamp_that_does_not_answer(
    ros_graph: Graph, browser: httpx.AsyncClient, virtual_clock: VirtualClock
) -> None:
    lamp = ros_graph.stub(SetBool, LAMP, {"message": "off"})
    assert (await browser.post("/lamp/false")).json() == {"lamp": "off"}
    with lamp.drop_responses():
        answer = await virtual_clock.skip(browser.post("/lamp/true"))
    assert answer.status_code == 504
    lamp.assert_requests({"data": False}, {"data": True})
