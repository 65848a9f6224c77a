"""What holds for the places of a service's clients at any time."""

from __future__ import annotations

from rosasync import Limits
from rosasync._client.client import Client
from rosasync._client.service import ServicePool

__all__ = ["check_places"]


def check_places(service: ServicePool, limits: Limits, open_leases: int = 0) -> None:
    """Check that places are neither lost nor doubled.

    Args:
        service: the service.
        limits: the limits of its session.
        open_leases: the leases that are open. One whose call was cancelled waits for its place
            before the next call: until then its window has one place too few.
    """
    assert len(service.clients) <= limits.clients
    for client in service.clients:
        _check_client(client, limits, open_leases)


def _check_client(client: Client, limits: Limits, open_leases: int) -> None:
    window = client.window
    holders = [sent for sent in window.sent.values() if sent.place]
    assert 0 <= window.leases <= limits.in_flight
    assert window.taken == window.leases + len(holders)
    # The window may have shrunk while its places were taken.
    assert window.taken <= max(window.size, limits.in_flight) + open_leases
    assert list(window.sent) == sorted(window.sent)
    assert all(number == sent.number for number, sent in window.sent.items())
    assert all(window.abandoned[number] is window.sent[number] for number in window.abandoned)
    for sent in holders:
        newest = sent.call is not None and sent.call.newest is sent
        assert (sent.number in window.abandoned) != newest
