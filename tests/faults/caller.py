"""A process of callers on a host of its own: ``python -m tests.faults.caller``."""

from __future__ import annotations

import asyncio
import random
import threading
import time
from typing import Any

from rosasync import Limits, Session
from tests.faults.table import Row
from tests.faults.trial import PATIENT, Trial, resident_megabytes
from tests.support.child import serve_commands
from tests.support.echo import ECHO, service_class
from tests.support.process import NodeProcess
from tests.support.times import LIMIT, TICK, until

__all__ = ["CallerProcess"]

TEN_MINUTES = 600.0


class CallerProcess(NodeProcess):
    """The parent's side of one such process."""

    module = "tests.faults.caller"
    stock = False

    async def start(
        self,
        fault: str,
        bridge: str,
        name: str,
        *,
        callers: int = 10,
        timeout: float = 40 * TICK,
        retry: bool = False,
        cancel: float = 0.0,
        pause: float = 0.0,
    ) -> None:
        """Begin to call; returns at once.

        Args:
            fault: the fault, for the row.
            bridge: the bridge of the session.
            name: the service.
            callers: how many callers make one call after the other.
            timeout: seconds for each call.
            retry: whether requests are sent again.
            cancel: the share of the calls that are cancelled.
            pause: the maximum number of seconds for which a caller pauses after each call.
        """
        await self.ask(
            "start",
            fault=fault,
            bridge=bridge,
            name=name,
            callers=callers,
            timeout=timeout,
            retry=retry,
            cancel=cancel,
            pause=pause,
        )

    async def answered(self) -> int:
        """Return how many calls have been answered so far."""
        count: int = await self.ask("answered")
        return count

    async def more_answers(self, count: int) -> None:
        """Wait until ``count`` more calls are answered."""
        enough = await self.answered() + count
        deadline = time.monotonic() + 3 * LIMIT
        while await self.answered() < enough:
            if time.monotonic() > deadline:
                state = await self.ask("state")
                raise AssertionError(f"less than {count} calls were answered: {state}")
            await asyncio.sleep(TICK)

    async def finds_server(self, name: str) -> bool:
        """Return whether a new stock client on the session's node is matched with a server."""
        found: bool = await self.ask("finds_server", name=name)
        return found

    async def stop(self) -> Row:
        """Let the calls end, make a last one, which has to be answered, and return the row."""
        return Row.from_json(await self.ask("stop"))


class _Callers:
    """The child's side: a loop in a thread of its own."""

    def __init__(self) -> None:
        self._enough = threading.Event()
        # Whether a last call has to be answered.
        self._stopped = False
        self._thread: threading.Thread | None = None
        self._trial: Trial | None = None
        self._session: Session | None = None
        self._failure: BaseException | None = None

    def start(self, **options: Any) -> None:
        self._enough.clear()
        self._trial = None
        self._thread = threading.Thread(target=self._work, kwargs=options)
        self._thread.start()

    def answered(self) -> int:
        if self._failure is not None:
            raise self._failure
        return self._trial.row.answered if self._trial is not None else 0

    def state(self) -> str:
        """Describe the calls so far, for the message of a failed test."""
        if self._trial is None or self._session is None:
            return "nothing was called yet"
        statistics = self._session.pool.statistics()
        return (
            f"{self._trial.row}, {dict(self._trial.failed)}, {statistics}, "
            f"and last {self._trial.last_error!r}"
        )

    def finds_server(self, name: str) -> bool:
        assert self._session is not None
        node = self._session.node
        client = node.create_client(service_class(ECHO), name)
        try:
            found: bool = client.wait_for_service(LIMIT)
            return found
        finally:
            node.destroy_client(client)

    def stop(self) -> str:
        self._stopped = True
        self.end()
        if self._failure is not None:
            raise self._failure
        assert self._trial is not None
        return self._trial.row.to_json()

    def end(self) -> None:
        self._enough.set()
        if self._thread is not None:
            self._thread.join()

    def _work(self, **options: Any) -> None:
        try:
            asyncio.run(self._call(**options))
        except BaseException as error:
            self._failure = error

    async def _call(
        self,
        fault: str,
        bridge: str,
        name: str,
        callers: int,
        cancel: float,
        pause: float,
        **options: Any,
    ) -> None:
        for _ in range(2):
            async with Session("warm", bridge=bridge):  # type: ignore[arg-type]
                pass
        options["retry"] = PATIENT if options["retry"] else None
        trial = self._trial = Trial(fault, bridge)
        chance = random.Random(17)

        async def one() -> None:
            task = asyncio.create_task(trial.call(session, name, **options))
            if chance.random() < cancel:
                await asyncio.sleep(0)
                asyncio.get_running_loop().call_later(chance.uniform(0, TICK), task.cancel)
            await asyncio.wait([task])
            failed = task.cancelled() or task.result() != "answered"
            if pause or failed:
                await asyncio.sleep(chance.uniform(0, pause or TICK))

        async def caller() -> None:
            while not self._enough.is_set():
                await one()

        async with trial.session(limits=Limits(grace=20 * TICK)) as session:
            self._session = session
            async with asyncio.TaskGroup() as group:
                group.create_task(self._watch_memory(trial))
                for _ in range(callers):
                    group.create_task(caller())
            if self._stopped:
                how = await trial.call(session, name, timeout=4 * LIMIT, retry=PATIENT)
                assert how == "answered", how
            trial.row.notes.append(f"{session.pool.statistics().retried:,} requests sent again")
        await trial.finish()

    async def _watch_memory(self, trial: Trial) -> None:
        """Note the memory after the first calls, after ten minutes and at the end."""
        await until(lambda: trial.row.answered > 100 or self._enough.is_set(), 6 * LIMIT)
        start = time.monotonic()
        sizes = {"at the start": resident_megabytes()}
        while not self._enough.is_set():
            await asyncio.sleep(TICK)
            if len(sizes) == 1 and time.monotonic() - start > TEN_MINUTES:
                sizes["after ten minutes"] = resident_megabytes()
        sizes["at the end"] = resident_megabytes()
        trial.row.notes.append(
            "memory, MB: " + ", ".join(f"{size:.1f} {when}" for when, size in sizes.items())
        )
        settled = list(sizes.values())[-2]
        trial.row.leaked["MB in the run"] = 0
        if sizes["at the end"] - settled > trial.growth / 2:
            trial.row.leaked["MB in the run"] = round(sizes["at the end"] - settled)


def main() -> None:
    callers = _Callers()
    serve_commands(callers)
    callers.end()


if __name__ == "__main__":
    main()
