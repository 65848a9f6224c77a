"""One rcl client: sends requests, and passes the responses to the calls that wait for them."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable, Collection, Hashable
from typing import TYPE_CHECKING, Any, Protocol

from rosasync._client.sent import Sent
from rosasync._client.window import Window
from rosasync._core.text import count

if TYPE_CHECKING:
    from rosasync._client.counts import Counts
    from rosasync._client.sent import Caller
    from rosasync._core.ports import ClientPort, Deliver, Servers
    from rosasync._status.listener import Listener
    from rosasync._status.wire import Report
    from rosasync.options import Limits

__all__ = ["Client", "ClientOwner"]


class ClientOwner(Protocol):
    """What a client needs to know of its service, and reports to it."""

    @property
    def queue(self) -> Collection[object]:
        """The callers that wait for a place."""

    @property
    def passed(self) -> Collection[object]:
        """The callers that have too little time left for a place."""

    @property
    def resends(self) -> Collection[object]:
        """The calls that wait to be sent again."""

    @property
    def leased(self) -> Collection[object]:
        """The calls that wait for the place of their lease."""

    def schedule(self) -> None:
        """Assign places in the next turn of the loop."""

    def on_places(self) -> None:
        """React to places in a window that may have become free."""

    def check_servers(self) -> None:
        """Look for requests that have lost all their servers."""

    def callers_wait(self) -> bool:
        """Return whether callers wait for a place or a match, or calls to be sent again."""

    def next_resend(self, client: Client) -> Sent | None:
        """Return the newest attempt of the first call that waits to be sent again by a client."""


class Client:
    """An rcl client, its window, and the calls it carries. Confined to the loop's thread.

    Attributes:
        window: its places and its outstanding requests.
        owner: its service.
        counts: the counters of the service.
        calls: the number of calls in flight. Written by `Call`.
        retried: those of them that may be sent again. Written by `Call`.
        servers: the servers that get the requests sent now. Written by `on_servers`.
        matched_generation: the generation of the graph in which a server was last seen matched.
            Written by `Clients`.
        idle_since: the loop time at which it was last in use. Written by `Call` and `Clients` too.
        closed: whether it was destroyed.
    """

    __slots__ = (
        "_listener",
        "_loop",
        "_port",
        "_timer",
        "_timer_due",
        "calls",
        "closed",
        "counts",
        "idle_since",
        "matched_generation",
        "owner",
        "retried",
        "servers",
        "window",
    )

    def __init__(
        self,
        open_port: Callable[[Deliver], ClientPort],
        limits: Limits,
        counts: Counts,
        owner: ClientOwner,
        listener: Listener,
    ) -> None:
        self._loop = asyncio.get_running_loop()
        self._listener = listener
        self.window = Window(limits.in_flight, limits.grace)
        self.owner = owner
        self.counts = counts
        self.calls = 0
        self.retried: dict[Caller, None] = {}
        self.servers: Servers = frozenset()
        self.matched_generation = -1
        self.idle_since = self._loop.time()
        self.closed = False
        # Set to the time at which the window has something to do. Started by requests without a
        # caller, and by callers who wait for the places of lost ones. Stopped if there are none.
        self._timer: asyncio.TimerHandle | None = None
        self._timer_due = math.inf
        self._port = open_port(self._deliver)
        listener.join(self._port.identity, self._on_report)

    def __repr__(self) -> str:
        state = "closed" if self.closed else "idle" if self.is_idle else "in use"
        return f"<Client {state}, {count(self.calls, 'call')}, {self.window!r}>"

    @property
    def identity(self) -> Hashable:
        """What servers know it by."""
        return self._port.identity

    @property
    def is_idle(self) -> bool:
        """Whether it has neither leases, nor calls, nor requests that take a place."""
        return not (self.window.leases or self.calls or self.window.abandoned)

    @property
    def is_outstanding(self) -> bool:
        """Whether a server may have a request that counts."""
        return bool(self.calls or self.window.abandoned)

    def ready(self) -> bool:
        """Return whether a server is matched; raises as `ClientPort.ready`."""
        return self._port.ready()

    def release(self) -> None:
        """End a lease."""
        self.window.release()
        self.idle_since = self._loop.time()
        self.owner.on_places()

    def resize(self, size: int) -> None:
        """Set the number of places."""
        grows, self.window.size = self.window.size < size, size
        if grows:
            self.owner.on_places()

    def send(self, call: Caller, now: float) -> Sent:
        """Send the request of a call and register it, in one turn.

        The thread that takes responses is this one. So none can arrive before it is registered.

        Raises:
            PortDestroyed: the client was destroyed.
        """
        number = self._port.send(call.request)
        sent = Sent(number, self.servers, now, call, call.lease is not None)
        # `Window.add`, inlined because every call comes here.
        window = self.window
        if window.taken == window.leases:
            window.silent_since = now
        window.taken += sent.place
        sent.out = window.taken
        window.sent[number] = sent
        window.last = number
        return sent

    def leave(self, sent: Sent, now: float) -> None:
        """Record that the caller of a request has left."""
        # The loop is closed if a task that was still pending is collected.
        if self.closed or self._loop.is_closed():
            return
        self.window.leave(sent, now)
        # Those that have left the graph have no queue any more.
        servers = sent.servers & self.servers
        if self._listener.depart(self._port.identity, sent.number, servers):
            # All of its servers drop it, so it is no longer in a queue.
            self.window.forgive(sent)
            self.owner.on_places()
        self.set_timer()

    def on_servers(self, servers: Servers, ended: Servers = frozenset()) -> None:
        """Set the servers that later requests get, and free the places of older requests."""
        self.servers = servers
        self.window.on_servers(servers, self._loop.time(), ended)
        self.set_timer()

    def lose_servers(self, servers: Servers, error: Callable[[], Exception]) -> None:
        """Forget the requests that no server has, and let their calls go on or end.

        Args:
            servers: the servers that there are now.
            error: makes the error for a call that ends.
        """
        lost = self.window.find_lost(servers)
        for sent in lost:
            self.window.remove(sent)
            self._port.forget(sent.number)
        # After all of them are removed: a call may have lost several.
        for sent in lost:
            call, sent.call = sent.call, None
            if call is not None:
                _lose(call, sent, error)
        self.set_timer()
        self.owner.on_places()

    def fail(self, error: Callable[[], Exception]) -> None:
        """End every call with an error, and forget the requests."""
        calls = {sent.call: None for sent in self.window.sent.values() if sent.call is not None}
        calls |= self.retried
        for sent in self.window.sent.values():
            self._port.forget(sent.number)
            sent.call = None
        self.window.clear()
        for call in calls:
            if not call.future.done():
                call.future.set_exception(error())
        self.owner.on_places()

    def close(self) -> None:
        """Destroy the rcl client; idempotent. `fail` it first, or its calls never end."""
        if self.closed:
            return
        self.closed = True
        self.window.clear()
        if self._timer is not None:
            self._timer.cancel()
        self._listener.leave(self._port.identity)
        self._port.close()

    def set_timer(self) -> None:
        """Set the timer anew, because the window, or who waits for its places, has changed."""
        if self.closed:
            return
        owner = self.owner
        due = self.window.due(owner.callers_wait(), owner.next_resend(self))
        if self._timer is not None:
            if self._timer_due == due:
                return
            self._timer.cancel()
            self._timer = None
        if due < math.inf:
            self._timer = self._loop.call_at(due, self._on_timer, due)
            # Not `when()`: uvloop gives no timer for a time that has come.
            self._timer_due = due

    def _deliver(self, number: int, response: Any) -> None:
        now = self._loop.time()
        sent = self.window.on_answer(number, now)
        if sent is None:
            # A number that was never sent is forged, or of a broken middleware: it says nothing.
            if number <= self.window.last:
                self.counts.late += 1
            return
        call, sent.call = sent.call, None
        if call is None:
            self.counts.late += 1
            self.owner.on_places()
        else:
            # Before the end of the call, which may send the next one: this completes the first.
            if call.future.done():
                self.counts.late += 1
            else:
                call.future.set_result(response)
            call.end(now)
        for retried in tuple(self.retried) if self.retried else ():
            retried.on_later_answer(number)
        if self._timer is not None:
            self.set_timer()

    def _on_report(self, report: Report) -> None:
        """End a request that no server will answer, by what the last of them has reported.

        A report of a request that is answered, or of a server that has not had it, says nothing.
        """
        sent = self.window.sent.get(report.number)
        if sent is None or report.server not in sent.servers:
            return
        sent.remove_server(report)
        if sent.servers:
            # With several servers on the name, another may still answer; or it has gone before.
            if sent.servers.isdisjoint(self.servers):
                self.owner.check_servers()
            return
        self.window.remove(sent)
        self._port.forget(sent.number)
        call, sent.call = sent.call, None
        if call is not None:
            call.refuse(sent, report)
        self.set_timer()
        self.owner.on_places()

    def _on_timer(self, due: float) -> None:
        self._timer = None
        # The loop runs timers up to one clock resolution early.
        now = max(due, self._loop.time())
        owner = self.owner
        resend = owner.next_resend(self)
        for sent in self.window.on_time(now, owner.callers_wait(), resend):
            self._port.forget(sent.number)
        owner.on_places()
        self.set_timer()


def _lose(call: Caller, sent: Sent, error: Callable[[], Exception]) -> None:
    """Tell a call that no server has its request: the last word is a report, if there was one."""
    if sent.report is None:
        call.lose(sent, error)
    else:
        call.refuse(sent, sent.report)
