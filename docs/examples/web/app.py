"""A web application that switches a lamp: each HTTP request is a service call.

Run it with ``uvicorn --factory app:create_app``.
"""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Annotated

from fastapi import APIRouter, Depends, FastAPI, Request
from fastapi.responses import JSONResponse
from std_srvs.srv import SetBool

import rosasync

LAMP = "/lamp/switch"
STATUS = {
    rosasync.ServiceUnavailable: 503,
    rosasync.PoolFull: 503,
    rosasync.SessionClosed: 503,
    rosasync.QueueTimeout: 504,
    rosasync.ResponseTimeout: 504,
}
"""The HTTP status of each error; 502 for others."""

router = APIRouter()


async def session_of(request: Request) -> rosasync.Session:
    session: rosasync.Session = request.app.state.session
    return session


Session = Annotated[rosasync.Session, Depends(session_of)]


@router.post("/lamp/{on}")
async def switch(on: bool, session: Session) -> dict[str, str]:
    response = await session.call(SetBool, LAMP, {"data": on})
    return {"lamp": response.message}


@router.get("/health")
async def health(session: Session) -> dict[str, object]:
    pool = session.pool.statistics()
    return {
        "lamp": session.service_is_ready(SetBool, LAMP),
        "calls": {"waiting": pool.waiting, "completed": pool.completed},
    }


async def explain(request: Request, error: Exception) -> JSONResponse:
    return JSONResponse({"detail": str(error)}, STATUS.get(type(error), 502))


def create_app(session: rosasync.Session | None = None) -> FastAPI:
    """Create the application; a test gives it a session of its own, not opened yet."""

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        async with session or rosasync.Session("web", timeout=5.0) as app.state.session:
            yield

    app = FastAPI(lifespan=lifespan, exception_handlers={rosasync.RosasyncError: explain})
    app.include_router(router)
    return app
