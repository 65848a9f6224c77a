"""Programs that end without closing their session: no abort, no hang, and a warning."""

from __future__ import annotations

import signal

import pytest

from tests.conftest import Bridge
from tests.support.program import run_program
from tests.support.servers import ServerProcess


@pytest.mark.usefixtures("echo")
class TestLeftOpen:
    """An unclosed session warns, and ends with the interpreter."""

    async def test_held_by_the_program(self, bridge: Bridge) -> None:
        code, errors = await run_program(bridge, "session = asyncio.run(opened(bridge))")
        assert code == 0, errors
        assert f"ResourceWarning: unclosed <Session 'left_open' {bridge} bridge" in errors
        assert "Traceback" not in errors

    async def test_dropped_by_the_program(self, bridge: Bridge) -> None:
        code, errors = await run_program(bridge, "asyncio.run(opened(bridge))")
        assert code == 0, errors
        assert f"ResourceWarning: unclosed <Session 'left_open' {bridge} bridge" in errors
        assert "Traceback" not in errors

    @pytest.mark.parametrize("kept", ["session = ", ""], ids=["held", "dropped"])
    async def test_if_the_warning_is_an_error(self, bridge: Bridge, kept: str) -> None:
        program = f"""
import threading, warnings
warnings.simplefilter("error", ResourceWarning)
{kept}asyncio.run(opened(bridge))
"""
        code, errors = await run_program(bridge, program)
        assert code == 0, errors
        assert "ResourceWarning: unclosed <Session 'left_open'" in errors
        assert "terminate called" not in errors

    async def test_dropped_in_a_loop_that_goes_on(self, bridge: Bridge) -> None:
        program = """
import gc, threading
async def main():
    await opened(bridge)
    gc.collect()
    while [t for t in threading.enumerate() if t.name.startswith("rosasync")]:
        await asyncio.sleep(0.01)
    async with Session("next", bridge=bridge) as session:
        await check_call(session, "/echo", "text")
asyncio.run(main())
"""
        code, errors = await run_program(bridge, program)
        assert code == 0, errors
        assert "ResourceWarning: unclosed <Session" in errors
        assert "Traceback" not in errors

    async def test_with_a_call_out(self, bridge: Bridge, server: ServerProcess) -> None:
        await server.serve("/never", delay="never")
        program = """
from tests.support.echo import ECHO
async def main():
    session = await opened(bridge)
    session.start(ECHO, "/never", timeout=None)
    await asyncio.sleep(0.1)
asyncio.run(main())
"""
        code, errors = await run_program(bridge, program)
        assert code == 0, errors
        assert "ResourceWarning: unclosed <Session" in errors


LEFT_TO_THE_COLLECTOR = """
import gc, threading, time
class App:
    async def main(self):
        global context
        self.session = Session("left_open", bridge=bridge)
        await self.session.open()
        context = self.session.node.context
        print("called", flush=True)
        self.session.serve("std_srvs/srv/Empty", "/own", self.handle)
    def handle(self, request, response):
        return response
gc.disable()
asyncio.run(App().main())
end = time.monotonic() + 20
while [t for t in threading.enumerate() if t.name.startswith("rosasync")]:
    assert time.monotonic() < end, "its thread goes on"
    time.sleep(0.01)
"""


@pytest.mark.usefixtures("echo")
class TestAbruptEnds:
    """The program ends before the session does."""

    async def test_an_exception_in_the_block(self, bridge: Bridge) -> None:
        program = """
async def main():
    async with Session("raiser", bridge=bridge) as session:
        await check_call(session, "/echo", "text")
        print("called", flush=True)
        raise SystemExit(7)
asyncio.run(main())
"""
        code, errors = await run_program(bridge, program)
        assert code == 7, errors
        assert "ResourceWarning" not in errors

    async def test_ctrl_c_while_a_call_is_out(self, bridge: Bridge, server: ServerProcess) -> None:
        await server.serve("/never", delay="never")
        program = """
from tests.support.echo import ECHO
async def main():
    async with Session("interrupted", bridge=bridge) as session:
        await check_call(session, "/echo", "text")
        task = session.start(ECHO, "/never", timeout=None)
        await asyncio.sleep(0)
        print("called", flush=True)
        await task
asyncio.run(main())
"""
        code, errors = await run_program(bridge, program, signal.SIGINT)
        assert code in (130, -signal.SIGINT), errors
        assert "KeyboardInterrupt" in errors
        assert "ResourceWarning" not in errors

    @pytest.mark.slow
    @pytest.mark.parametrize(
        ("loop", "handles"),
        [("asyncio", True), ("uvloop", False)],
        ids=["asyncio with a signal handler", "uvloop"],
    )
    async def test_ctrl_c_that_another_thread_gets_wakes_an_idle_loop(
        self, bridge: Bridge, loop: str, handles: bool
    ) -> None:
        """As `docs/how-to/deploy.md` says. Without the handler, asyncio's loop goes on sleeping."""
        program = """
import importlib, signal, threading, time
def interrupt():
    time.sleep(2.0)  # The pool polls for a moment after a call.
    signal.pthread_kill(threading.get_ident(), signal.SIGINT)
async def main():
    stop = asyncio.Event()
    if HANDLES:
        asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, stop.set)
    async with Session("idle", bridge=bridge, timeout=None) as session:
        # A deadline would be a timer, which wakes the loop.
        await check_call(session, "/echo", "text", timeout=None)
        print("called", flush=True)
        threading.Thread(target=interrupt).start()
        await stop.wait()
importlib.import_module(LOOP).run(main())
"""
        program = program.replace("HANDLES", str(handles)).replace("LOOP", repr(loop))
        code, errors = await run_program(bridge, program)
        assert code in (130, -signal.SIGINT), errors
        assert "KeyboardInterrupt" in errors
        assert "ResourceWarning" not in errors

    async def test_a_loop_closed_under_an_open_session(
        self, bridge: Bridge, server: ServerProcess
    ) -> None:
        await server.serve("/slow", delay=0.3)
        program = """
import time
from tests.support.echo import ECHO, request_of
loop = asyncio.new_event_loop()
session = loop.run_until_complete(opened(bridge))
async def send_and_give_up():
    task = session.start(ECHO, "/slow", request_of("out"))
    await asyncio.sleep(0.1)
    task.cancel()
    await asyncio.wait([task])
loop.run_until_complete(send_and_give_up())
loop.close()
time.sleep(0.5)
"""
        code, errors = await run_program(bridge, program)
        assert code == 0, errors
        assert "ResourceWarning: unclosed <Session" in errors
        assert "Traceback" not in errors

    async def test_a_closed_loop_and_a_handler_that_refers_to_the_session(
        self, bridge: Bridge
    ) -> None:
        program = """
gc.collect()
print("collected", file=sys.stderr, flush=True)
"""
        code, errors = await run_program(bridge, LEFT_TO_THE_COLLECTOR + program)
        assert code == 0, errors
        assert "ResourceWarning: unclosed <Session" in errors.partition("collected")[0]
        assert "Traceback" not in errors

    async def test_the_garbage_collector_is_faster_than_the_clean_up(self, bridge: Bridge) -> None:
        """It finalizes everything before the thread that cleans up has its first turn."""
        program = """
warnings.simplefilter("ignore")
interval = sys.getswitchinterval()
sys.setswitchinterval(60)
gc.collect()
sys.setswitchinterval(interval)
while context.ok():
    assert time.monotonic() < end, "its node is not destroyed"
    time.sleep(0.01)
"""
        code, errors = await run_program(bridge, LEFT_TO_THE_COLLECTOR + program)
        assert code == 0, errors
        assert "Exception ignored" not in errors

    async def test_the_context_goes_down_first(self, bridge: Bridge) -> None:
        program = """
async def main():
    session = await opened(bridge)
    session.node.context.shutdown()
    await session.aclose()
asyncio.run(main())
"""
        code, errors = await run_program(bridge, program)
        assert code == 0, errors
        assert errors == ""
