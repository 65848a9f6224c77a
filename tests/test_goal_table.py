"""The goals of a server: their states, cancel requests, expiry, and the status message."""

from __future__ import annotations

import math
from itertools import product

import pytest
from action_msgs.msg import GoalStatusArray
from action_msgs.srv import CancelGoal
from rclpy.serialization import deserialize_message, serialize_message

from rosasync import to_message
from rosasync._actions.goal_table import (
    NO_GOAL,
    CancelCode,
    GoalEvent,
    GoalRecord,
    GoalTable,
    next_status,
)
from rosasync._actions.status import GoalStatus
from rosasync._actions.status_list import StatusList, decode_statuses

S, E = GoalStatus, GoalEvent

ALLOWED = {
    (S.ACCEPTED, E.EXECUTE): S.EXECUTING,
    (S.ACCEPTED, E.CANCEL_GOAL): S.CANCELING,
    (S.EXECUTING, E.CANCEL_GOAL): S.CANCELING,
    (S.EXECUTING, E.SUCCEED): S.SUCCEEDED,
    (S.EXECUTING, E.ABORT): S.ABORTED,
    (S.CANCELING, E.SUCCEED): S.SUCCEEDED,
    (S.CANCELING, E.ABORT): S.ABORTED,
    (S.CANCELING, E.CANCELED): S.CANCELED,
}


def goal_id(number: int) -> bytes:
    return bytes([number] * 16)


def table(*statuses: GoalStatus, result_timeout: float = 900.0) -> GoalTable:
    """A table with a goal in each status; goal n was accepted at n ns."""
    goals = GoalTable(result_timeout)
    for number, status in enumerate(statuses, 1):
        bring(goals, goals.accept(goal_id(number), number), status)
    return goals


def bring(goals: GoalTable, goal: GoalRecord, status: GoalStatus, now: float = 0.0) -> None:
    path = {
        S.ACCEPTED: (),
        S.EXECUTING: (E.EXECUTE,),
        S.CANCELING: (E.EXECUTE, E.CANCEL_GOAL),
        S.SUCCEEDED: (E.EXECUTE, E.SUCCEED),
        S.CANCELED: (E.CANCEL_GOAL, E.CANCELED),
        S.ABORTED: (E.EXECUTE, E.ABORT),
    }
    for event in path[status]:
        assert goals.apply(goal, event, now)
    assert goal.status is status


@pytest.mark.parametrize(("status", "event"), list(product(S, E)))
def test_every_transition(status: GoalStatus, event: GoalEvent) -> None:
    assert next_status(status, event) is ALLOWED.get((status, event))
    if status is S.UNKNOWN:
        return
    goals = table(status)
    (goal,) = goals
    assert goals.apply(goal, event, 0.0) is ((status, event) in ALLOWED)
    assert goal.status is ALLOWED.get((status, event), status)


def test_the_codes_are_those_of_the_message() -> None:
    response = CancelGoal.Response
    assert [*CancelCode] == [
        response.ERROR_NONE,
        response.ERROR_REJECTED,
        response.ERROR_UNKNOWN_GOAL_ID,
        response.ERROR_GOAL_TERMINATED,
    ]


def test_a_goal_id_is_accepted_once() -> None:
    goals = table(S.SUCCEEDED)
    with pytest.raises(ValueError, match="accepted before"):
        goals.accept(goal_id(1), 5)


ALL = (S.ACCEPTED, S.EXECUTING, S.CANCELING, S.SUCCEEDED, S.CANCELED, S.ABORTED)


@pytest.mark.parametrize(
    ("request_id", "stamp", "code", "selected"),
    [
        (NO_GOAL, 0, CancelCode.NONE, [1, 2]),
        (NO_GOAL, 1, CancelCode.NONE, [1]),
        (NO_GOAL, 6, CancelCode.NONE, [1, 2]),
        (goal_id(1), 0, CancelCode.NONE, [1]),
        (goal_id(2), 0, CancelCode.NONE, [2]),
        (goal_id(3), 0, CancelCode.GOAL_TERMINATED, []),
        (goal_id(4), 0, CancelCode.GOAL_TERMINATED, []),
        (goal_id(5), 0, CancelCode.GOAL_TERMINATED, []),
        (goal_id(6), 0, CancelCode.GOAL_TERMINATED, []),
        (goal_id(9), 0, CancelCode.UNKNOWN_GOAL_ID, []),
        (goal_id(2), 1, CancelCode.NONE, [1, 2]),
        (goal_id(3), 1, CancelCode.NONE, [1]),
        (goal_id(9), 1, CancelCode.NONE, [1]),
    ],
)
def test_what_a_cancel_request_asks_for(
    request_id: bytes, stamp: int, code: CancelCode, selected: list[int]
) -> None:
    selection = table(*ALL).select(request_id, stamp)
    assert selection.code is code
    assert [goal.id for goal in selection.goals] == [goal_id(number) for number in selected]


def test_cancelling_everything_finds_nothing() -> None:
    assert table().select(NO_GOAL, 0) == (CancelCode.NONE, [])
    assert table(S.SUCCEEDED).select(NO_GOAL, 0) == (CancelCode.NONE, [])


def test_goals_expire_after_their_end() -> None:
    goals = table(S.ACCEPTED, S.EXECUTING, S.CANCELING, result_timeout=10.0)
    first, second, third = goals
    assert goals.expiry() is None
    assert goals.expire(1e9) == []
    bring(goals, goals.accept(goal_id(4), 4), S.ABORTED, now=5.0)
    goals.apply(second, E.SUCCEED, 7.0)
    goals.apply(third, E.CANCELED, 7.0)
    assert goals.expiry() == 15.0
    assert goals.expire(14.9) == []
    assert [goal.id for goal in goals.expire(15.0)] == [goal_id(4)]
    assert goals.expiry() == 17.0
    assert goals.expire(20.0) == [second, third]
    assert [*goals] == [first]
    assert goals.get(second.id) is None
    assert goals.select(second.id, 0).code is CancelCode.UNKNOWN_GOAL_ID
    goals.accept(second.id, 30)


def test_goals_that_never_expire() -> None:
    goals = table(S.SUCCEEDED, result_timeout=math.inf)
    assert goals.expiry() is None
    assert goals.expire(math.inf) == []
    assert len(goals) == 1


class TestStatusList:
    def test_rclpy_reads_it(self) -> None:
        statuses = StatusList()
        assert statuses.encode() == serialize_message(GoalStatusArray())
        assert decode_statuses(statuses.encode()) == {"status_list": []}
        for number in range(5):
            statuses.set(goal_id(number), 1_700_000_000_123_456_789 + number, number + 1)
            encoded = statuses.encode()
            assert len(encoded) == len(serialize_message(decode(statuses)))
            assert to_message(GoalStatusArray, decode_statuses(encoded)) == decode(statuses)
        statuses.set(goal_id(2), 7_000_000_009, 4)
        statuses.remove(goal_id(1))
        listed = decode(statuses).status_list
        assert [int(each.goal_info.goal_id.uuid[0]) for each in listed] == [0, 2, 3, 4]
        assert [each.status for each in listed] == [1, 4, 4, 5]
        stamp = listed[1].goal_info.stamp
        assert (stamp.sec, stamp.nanosec) == (7, 9)


def decode(statuses: StatusList) -> GoalStatusArray:
    return deserialize_message(statuses.encode(), GoalStatusArray)
