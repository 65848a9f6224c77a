"""The application, called by httpx as by 300 browsers: in memory, and on real ROS."""

import asyncio
import itertools
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import httpx
import pytest
import pytest_asyncio
from app import CAMERA, LAMP, create_app
from sensor_msgs.srv import SetCameraInfo
from std_srvs.srv import SetBool

import rosasync
from rosasync.testing import Graph, VirtualClock

pytestmark = [
    pytest.mark.asyncio,
    pytest.mark.parametrize("ros_graph", ["memory", "real"], indirect=True),
]


@asynccontextmanager
async def browsing(session: rosasync.Session) -> AsyncIterator[httpx.AsyncClient]:
    app = create_app(session)
    transport = httpx.ASGITransport(app)
    # httpx does not run the lifespan of an application.
    async with (
        app.router.lifespan_context(app),
        httpx.AsyncClient(transport=transport, base_url="http://robot") as client,
    ):
        yield client


@pytest_asyncio.fixture
async def browser(ros_graph: Graph) -> AsyncIterator[httpx.AsyncClient]:
    async with browsing(ros_graph.session("web")) as client:
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
    assert answer.headers["Retry-After"] == "1"
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


async def test_a_message_as_json(ros_graph: Graph, browser: httpx.AsyncClient) -> None:
    camera = ros_graph.stub(SetCameraInfo, CAMERA, {"success": True})
    body = {"camera_info": {"width": 640, "d": [0.5, "NaN"]}}
    answer = await browser.put("/camera", json=body)
    assert answer.json() == {"success": True, "status_message": ""}
    (request,) = camera.requests
    assert request["camera_info"]["width"] == 640

    body = {"camera_info": {"width": -1}}
    answer = await browser.put("/camera", json=body)
    assert answer.status_code == 422
    assert "camera_info.width: -1 is out of the range of uint32" in answer.json()["detail"]
    camera.assert_called(times=1)


async def test_the_message_is_described(browser: httpx.AsyncClient) -> None:
    operation = (await browser.get("/openapi.json")).json()["paths"]["/camera"]["put"]
    schema = operation["requestBody"]["content"]["application/json"]["schema"]
    width = schema["$defs"]["sensor_msgs.msg.CameraInfo"]["properties"]["width"]
    assert (width["minimum"], width["maximum"]) == (0, 2**32 - 1)


async def test_too_many_wait(ros_graph: Graph) -> None:
    lamp = ros_graph.stub(SetBool, LAMP, {"message": "on"})
    limits = rosasync.Limits(in_flight=1, waiting=1)
    async with browsing(ros_graph.session("web", limits=limits)) as browser:
        assert (await browser.post("/lamp/true")).status_code == 200
        with lamp.hold_responses():
            answers = [asyncio.create_task(browser.post("/lamp/true")) for _ in range(3)]
            (refused,), _ = await asyncio.wait(answers, return_when=asyncio.FIRST_COMPLETED)
        assert refused.result().status_code == 503
        assert refused.result().headers["Retry-After"] == "1"
        statuses = [answer.status_code for answer in await asyncio.gather(*answers)]
        assert sorted(statuses) == [200, 200, 503]
