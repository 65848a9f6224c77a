"""Errors keep their message and attributes in copies and other processes."""

from __future__ import annotations

import copy
import multiprocessing
import pickle
from uuid import UUID

import pytest

import rosasync
from rosasync import CallError, GoalError, RosasyncError
from tests.support.times import LIMIT

KINDS = [
    rosasync.CallError,
    rosasync.ServiceUnavailable,
    rosasync.QueueTimeout,
    rosasync.ResponseTimeout,
    rosasync.ServerGone,
    rosasync.GoalError,
    rosasync.GoalRejected,
    rosasync.GoalAborted,
    rosasync.GoalCanceled,
    rosasync.GoalTimeout,
    rosasync.CancelRejected,
]


def make(kind: type[CallError]) -> CallError:
    error = kind("/echo: no", srv_name="/echo", srv_type="std_srvs/srv/SetBool", elapsed=1.5)
    if isinstance(error, GoalError):
        error.goal_id = UUID(int=7)
        error.result = ["a result"]
    error.add_note("a note")
    return error


def fail(kind: type[CallError]) -> None:
    raise make(kind)


def details(error: CallError) -> tuple[object, ...]:
    own = (error.goal_id, error.result) if isinstance(error, GoalError) else ()
    notes = error.__notes__
    return type(error), str(error), error.srv_name, error.srv_type, error.elapsed, notes, *own


@pytest.mark.parametrize("kind", KINDS)
def test_a_call_error_is_copied_and_pickled(kind: type[CallError]) -> None:
    error = make(kind)
    for twin in (copy.copy(error), copy.deepcopy(error), pickle.loads(pickle.dumps(error))):
        assert details(twin) == details(error)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_a_call_error_comes_out_of_a_process_pool(kind: type[CallError]) -> None:
    with multiprocessing.get_context("spawn").Pool(1) as pool, pytest.raises(kind) as caught:
        pool.apply_async(fail, (kind,)).get(LIMIT)
    assert details(caught.value) == details(make(kind))


@pytest.mark.parametrize(
    "error",
    [
        rosasync.SessionClosed("no"),
        rosasync.ContextShutdown(),
        rosasync.UsageError("no"),
        rosasync.InvalidServiceName("no"),
        rosasync.PoolFull("no"),
    ],
)
def test_every_other_error_as_well(error: RosasyncError) -> None:
    for twin in (copy.copy(error), pickle.loads(pickle.dumps(error))):
        assert (type(twin), str(twin)) == (type(error), str(error))
