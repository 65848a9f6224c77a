"""What servers and callers tell each other arrives as it was sent, and nothing else is taken."""

from __future__ import annotations

from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from hypothesis import given
from hypothesis import strategies as st
from rclpy.serialization import deserialize_message, serialize_message
from service_msgs.msg import ServiceEventInfo

from rosasync import to_message
from rosasync._status.wire import (
    Departure,
    Outcome,
    Report,
    departure_topic,
    identity_bytes,
    process_of,
    report_topic,
)

IDENTITIES = st.binary(min_size=16, max_size=16)
NUMBERS = st.integers(min_value=1, max_value=2**63 - 1)
# What C strings and UTF-8 can carry.
TEXTS = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]))
REPORT = Report("/x", bytes(16), bytes(16), 1, Outcome.FAILED, "builtins.ValueError", "no")


def sent(message_type: type[Any], mapping: dict[str, Any]) -> Any:
    """Return a message as it arrives."""
    return deserialize_message(serialize_message(to_message(message_type, mapping)), message_type)


@given(
    st.builds(
        Report, TEXTS, IDENTITIES, IDENTITIES, NUMBERS, st.sampled_from(Outcome), TEXTS, TEXTS
    )
)
def test_a_report_arrives_as_it_was_sent(report: Report) -> None:
    assert Report.read(sent(DiagnosticStatus, report.to_mapping())) == report


@given(st.builds(Departure, IDENTITIES, NUMBERS))
def test_a_departure_arrives_as_it_was_sent(departure: Departure) -> None:
    assert Departure.read(sent(ServiceEventInfo, departure.to_mapping())) == departure


@pytest.mark.parametrize(
    "change",
    [
        {"hardware_id": "not hexadecimal"},
        {"values": []},
        {"values": [{"key": "client", "value": "00"}]},
    ],
)
def test_what_is_no_report_is_refused(change: dict[str, Any]) -> None:
    message = sent(DiagnosticStatus, {**REPORT.to_mapping(), **change})
    with pytest.raises(ValueError, match=r"."):
        Report.read(message)


def test_events_of_introspection_are_no_departures() -> None:
    message = sent(ServiceEventInfo, {**Departure(bytes(16), 1).to_mapping(), "event_type": 1})
    with pytest.raises(ValueError, match="type 1"):
        Departure.read(message)


def test_the_topics_of_a_process_are_hidden_and_its_own() -> None:
    one, other = (process_of(bytes([n]) * 16) for n in (1, 2))
    assert one is not None
    assert other is not None
    assert process_of(bytes([1]) * 12 + b"xxxx") == one != other
    topics = {f(name) for f in (report_topic, departure_topic) for name in (one, other)}
    assert len(topics) == 4
    assert all(topic.startswith("/_rosasync/") for topic in topics)


@pytest.mark.parametrize("identity", [None, 3, "x" * 16, bytes(15), bytes(24)])
def test_a_middleware_without_such_identities_takes_no_part(identity: Any) -> None:
    assert identity_bytes(identity) is None
    assert process_of(identity) is None
