"""Where requests come from: an argument, a file, standard input, or a template to edit."""

from __future__ import annotations

import asyncio
import os
import re
import sys
from collections.abc import AsyncIterator, Iterator
from typing import Any

import typer

from rosasync._cli.documents import DocumentError, documents, plain, read_message
from rosasync._cli.emitter import dump_yaml
from rosasync._cli.errors import CliError, join
from rosasync._core.safe_yaml import MAX_BYTES, read_bytes
from rosasync._ros.interfaces import Field, fields
from rosasync._ros.types import type_name

__all__ = ["message_from", "requests_from", "rounds_of", "split_type", "template"]

STDIN = "-"
CHUNK = 65536
_TIMED = re.compile(r"\b(now|auto)\b")
TOO_LARGE = f"a document of standard input is larger than {MAX_BYTES // 1024**2} MiB"


def split_type(srv_type: str | None, text: str | None) -> tuple[str | None, str | None]:
    """Tell the type from the request where only one of the two was given.

    Raises:
        typer.BadParameter: it is the name, which comes first, or the request, which comes last.
    """
    if srv_type is not None and re.fullmatch(r"(/\w+)+", srv_type):
        raise typer.BadParameter(f"{srv_type!r} is a name: give the name first, and then the type")
    if text is not None and srv_type is not None and re.search(r"[{}:]", srv_type):
        quoted = join(f"{srv_type!r} is YAML, which comes last", "With spaces it needs quotes")
        raise typer.BadParameter(f"{quoted}: '{{data: true}}'")
    if text is None and srv_type is not None and not re.fullmatch(r"[\w]+(/\w+)+", srv_type):
        return None, srv_type
    return srv_type, text


def message_from(message_type: type[Any], text: str | None) -> Any:
    """Read one message, from YAML or from ``@file``; None for an empty one.

    Raises:
        CliError: there is no such file, more than one document, or it does not fit the type.
    """
    found = list(documents(_text_of(text or "{}")))
    if len(found) > 1:
        raise CliError(f"expected one document, got {len(found)}")
    return _read(message_type, found[0] if found else "{}")


async def requests_from(message_type: type[Any], text: str | None) -> AsyncIterator[Any]:
    """Read the requests: one from the argument, each document of a file or of standard input.

    Raises:
        CliError: a document cannot be read, or does not fit the type.
    """
    if text != STDIN:
        for document in list(documents(_text_of(text or "{}"))) or ["{}"]:
            yield _read(message_type, document)
        return
    async for document in _stdin_documents():
        yield _read(message_type, document)


def rounds_of(message_type: type[Any], text: str | None) -> Iterator[list[Any]]:
    """Yield the requests of an argument or a file for ever, read again if they have a time of now.

    Raises:
        CliError: as `requests_from`.
    """
    found = list(documents(_text_of(text or "{}"))) or ["{}"]
    timed = any(_TIMED.search(document) for document in found)
    messages = [_read(message_type, document) for document in found]
    while True:
        yield messages
        if timed:
            messages = [_read(message_type, document) for document in found]


def template(message_type: type[Any]) -> str:
    """Return a request with its defaults, and types and comments, as YAML to edit."""
    lines = [f"# {type_name(message_type)}", *_template_lines(message_type(), "")]
    return "\n".join(lines) if len(lines) > 1 else f"{lines[0]} has no fields\n{{}}"


def _template_lines(message: Any, indent: str) -> Iterator[str]:
    values = plain(message)
    for field in fields(type(message)):
        comment = f"  # {field.type.label}{': ' if field.comment else ''}{field.comment}"
        if field.type.kind != "message":
            yield f"{indent}{field.name}: {dump_yaml(values[field.name])}{comment}"
            if field.type.element is not None and field.type.element.message_type is not None:
                yield from _element_lines(field, indent)
            continue
        nested = getattr(message, field.name)
        inner = list(_template_lines(nested, f"{indent}  "))
        yield f"{indent}{field.name}:{'' if inner else ' {}'}{comment}"
        yield from inner


def _element_lines(field: Field, indent: str) -> Iterator[str]:
    """Show an element of a sequence of messages, as a comment."""
    assert field.type.element is not None
    assert field.type.element.message_type is not None
    lines = dump_yaml(plain(field.type.element.message_type())).splitlines()
    for number, line in enumerate(lines):
        yield f"{indent}# {'- ' if number == 0 else '  '}{line}"


def _text_of(text: str) -> str:
    """Return the text itself, or that of the file it names."""
    if text == STDIN:
        return _decode(sys.stdin.buffer.read(MAX_BYTES + 1))
    if not text.startswith("@"):
        return text
    try:
        return read_bytes(text[1:]).decode()
    except (OSError, UnicodeDecodeError) as error:
        raise CliError(f"cannot read {text[1:]}: {error}") from None


def _decode(data: bytes) -> str:
    """Return the text that was read from standard input."""
    try:
        return data.decode()
    except UnicodeDecodeError as error:
        raise CliError(f"standard input is not text in UTF-8: {error}") from None


def _read(message_type: type[Any], document: str) -> Any:
    try:
        return read_message(message_type, document)
    except DocumentError as error:
        kind = type_name(message_type).removesuffix("_Request").removesuffix("_Response")
        raise CliError(join(str(error), f"Try: rosasync show {kind}")) from None


async def _stdin_documents() -> AsyncIterator[str]:
    """Yield each document as soon as the next one begins, or the input ends."""
    lines: list[str] = []
    size = 0
    async for line in _stdin_lines():
        if re.match(r"---(?=\s|$)", line):
            for document in documents("".join(lines)):
                yield document
            lines, size = [], 0
        lines.append(line)
        size += len(line)
        if size > MAX_BYTES:
            raise CliError(TOO_LARGE)
    for document in documents("".join(lines)):
        yield document


async def _stdin_lines() -> AsyncIterator[str]:
    """Read standard input without a thread, which could not be ended while it blocks."""
    # The parts of the line that has not ended.
    parts: list[bytes] = []
    while chunk := await _stdin_chunk():
        end, *others = chunk.split(b"\n")
        parts.append(end)
        for start in others:
            yield _decode(b"".join(parts)) + "\n"
            parts = [start]
        if len(parts) > MAX_BYTES // CHUNK:
            raise CliError(TOO_LARGE)
    yield _decode(b"".join(parts))


async def _stdin_chunk() -> bytes:
    loop = asyncio.get_running_loop()
    readable = asyncio.Event()
    fd = sys.stdin.fileno()
    try:
        loop.add_reader(fd, readable.set)
    except PermissionError:  # a file, which is always readable
        return os.read(fd, CHUNK)
    try:
        await readable.wait()
    finally:
        loop.remove_reader(fd)
    return os.read(fd, CHUNK)
