"""A web application for a lamp and a camera: each HTTP request is a service call.

Run it with ``uvicorn --factory app:create_app``.
"""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Annotated, Any

from fastapi import APIRouter, Body, Depends, FastAPI, HTTPException, Request
from fastapi.responses import JSONResponse
from sensor_msgs.srv import SetCameraInfo
from std_srvs.srv import SetBool

import rosasync

LAMP = "/lamp/switch"
CAMERA = "/camera/set_camera_info"
STATUS = {
    rosasync.ServiceUnavailable: 503,
    rosasync.PoolFull: 503,
    rosasync.SessionClosed: 503,
    rosasync.QueueTimeout: 504,
    rosasync.ResponseTimeout: 504,
}
"""The HTTP status of each error; 502 for others."""
RETRY_AFTER = "1"
"""Seconds after which a client may try again, if the status is 503."""

router = APIRouter()


async def session_of(request: Request) -> rosasync.Session:
    session: rosasync.Session = request.app.state.session
    return session


def message_of(message_type: type[Any], body: dict[str, Any]) -> Any:
    """Return the message in a body of JSON; a status of 422 says which field does not fit."""
    try:
        return rosasync.to_message(message_type, body)
    except (TypeError, ValueError) as error:
        raise HTTPException(422, str(error)) from error


def body_of(message_type: type[Any]) -> dict[str, Any]:
    """Return what OpenAPI needs to describe a body that is a message."""
    schema = rosasync.json_schema(message_type)
    return {"requestBody": {"content": {"application/json": {"schema": schema}}}}


Session = Annotated[rosasync.Session, Depends(session_of)]


@router.post("/lamp/{on}")
async def switch(on: bool, session: Session) -> dict[str, str]:
    response = await session.call(SetBool, LAMP, {"data": on})
    return {"lamp": response.message}


@router.put("/camera", openapi_extra=body_of(SetCameraInfo.Request))
async def calibrate(body: Annotated[dict[str, Any], Body()], session: Session) -> dict[str, Any]:
    response = await session.call(SetCameraInfo, CAMERA, message_of(SetCameraInfo.Request, body))
    return rosasync.to_dict(response, json=True)


@router.get("/health")
async def health(session: Session) -> dict[str, object]:
    pool = session.pool.statistics()
    return {
        "lamp": session.service_is_ready(SetBool, LAMP),
        "calls": {"waiting": pool.waiting, "completed": pool.completed},
    }


async def explain(request: Request, error: Exception) -> JSONResponse:
    status = STATUS.get(type(error), 502)
    headers = {"Retry-After": RETRY_AFTER} if status == 503 else None
    return JSONResponse({"detail": str(error)}, status, headers)


def create_app(session: rosasync.Session | None = None) -> FastAPI:
    """Create the application; a test gives it a session of its own, not opened yet."""

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        async with session or rosasync.Session("web", timeout=5.0) as app.state.session:
            yield

    app = FastAPI(lifespan=lifespan, exception_handlers={rosasync.RosasyncError: explain})
    app.include_router(router)
    return app
