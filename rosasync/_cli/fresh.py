"""``rosasync run``: start a program at a port that no dead process has left behind."""

from __future__ import annotations

import hashlib
import os
import signal
import sys
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import Annotated

import typer

from rosasync._cli.errors import CliError, Code
from rosasync._cli.introducer import introduce_program
from rosasync._cli.output import note
from rosasync._cli.run import fail
from rosasync._ros.domain import environment_domain
from rosasync._ros.fresh_ports import fresh_offset
from rosasync._ros.profile import (
    ANNOUNCEMENT,
    is_old,
    profile_text,
    profile_variable,
    switched_off,
    user_profile,
    with_offset,
)
from rosasync.errors import RosasyncError

__all__ = ["fresh_profile", "run_fresh"]

NOT_EXECUTABLE, NOT_FOUND = 126, 127
"""Exit codes of a shell."""


def run_fresh(
    command: Annotated[
        list[str], typer.Argument(metavar="COMMAND...", help="The program and its arguments.")
    ],
) -> None:
    """Run a program that its peers reach at once, also after a crash of its predecessor.

    Gives it a Fast DDS profile in its environment: a port that no dead process has left behind,
    and what `rosasync profile` prints. If you have a profile, it gets a copy of that with the port.
    For up to 30 s, a second process asks its peers to announce themselves to its nodes.
    The program replaces this process, so signals and the exit code are its own.

    \b
    Examples:
      $ rosasync run -- python server.py
      $ rosasync run ros2 run demo_nodes_py add_two_ints_server
    """
    environ = dict(os.environ)
    try:
        if not switched_off() and "fastrtps" in environ.get("RMW_IMPLEMENTATION", "fastrtps"):
            variable = profile_variable(is_old())
            domain = environment_domain()
            with suppress(OSError):
                introduce_program(domain)
            environ[variable] = str(_write(fresh_profile(domain, is_old())))
    except RosasyncError as error:
        fail(error)
        raise typer.Exit(Code.USAGE) from None
    except (OSError, CliError) as error:
        note(f"rosasync: started without a fresh port: {error}")
    raise typer.Exit(_execute(command, environ))


def fresh_profile(domain: int, old: bool) -> str:
    """Return the profile for a process that is about to start.

    Raises:
        CliError: the user's profile cannot be used, or no port is left.
    """
    offset = fresh_offset(domain)
    if offset is None:
        raise CliError("every port has been left behind by a dead process: see rosasync doctor")
    file = user_profile(old)
    if file is None:
        return profile_text(old, announcement=ANNOUNCEMENT, offset=offset)
    try:
        return with_offset(file.read_text(), offset)
    except (OSError, ValueError) as error:
        raise CliError(f"your profile {file} stays as it is: {error}") from None


def _write(text: str) -> Path:
    """Write a profile to a file that lives as long as any process may read it.

    The same text is the same file, so there are never more than there are ports.
    """
    folder = Path(tempfile.gettempdir()) / f"rosasync-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    if folder.is_symlink() or folder.stat().st_uid != os.getuid():
        raise OSError(f"{folder} belongs to another user")
    file = folder / f"{hashlib.sha256(text.encode()).hexdigest()[:16]}.xml"
    if not file.exists():
        with tempfile.NamedTemporaryFile("w", dir=folder, delete=False) as written:
            written.write(text)
        os.replace(written.name, file)
    return file


def _execute(command: list[str], environ: dict[str, str]) -> int:
    """Replace this process by a program; return the exit code if that fails."""
    sys.stdout.flush()
    if sys.stdout.fileno() != 1:
        # The command line has put its errors there.
        os.dup2(sys.stdout.fileno(), 1)
    # Python ignores it, and the program would inherit that.
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)
    try:
        os.execvpe(command[0], command, environ)
    except FileNotFoundError:
        fail(f"{command[0]}: no such program")
        return NOT_FOUND
    except OSError as error:
        fail(f"{command[0]} cannot be run: {error.strerror}")
        return NOT_EXECUTABLE
