"""``rosasync show``: what a type consists of."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from rosasync._cli.documents import plain
from rosasync._cli.emitter import dump_yaml
from rosasync._cli.errors import CliError, Code
from rosasync._cli.graph import explain_type
from rosasync._cli.options import AnyType, AsJson
from rosasync._cli.output import print_json
from rosasync._cli.run import run
from rosasync._ros.interfaces import Field, constants, fields, parts

__all__ = ["show"]


def show(srv_type: AnyType, as_json: AsJson = False) -> None:
    """Show the fields, defaults and constants of a type.

    Fields of nested messages are indented below their field.

    \b
    Examples:
      $ rosasync show std_srvs/srv/SetBool
      $ rosasync show rcl_interfaces/srv/GetParameters --json
    """
    run(_show(srv_type, as_json))


async def _show(srv_type: str, as_json: bool) -> int:
    try:
        found = parts(srv_type)
    except ValueError as error:
        raise CliError(explain_type(srv_type, error)) from None
    if as_json:
        messages = {part.name or "message": _described(part.message_type) for part in found}
        print_json({"type": srv_type, **messages})
        return Code.ANSWERED
    for number, part in enumerate(found):
        if number:
            print("---")
        print("\n".join(_lines(part.message_type, "")) or "# no fields")
    return Code.ANSWERED


def _lines(message_type: type[Any], indent: str) -> Iterator[str]:
    for name, value in _constants(message_type).items():
        yield f"{indent}{name} = {dump_yaml(value)}"
    defaults = plain(message_type())
    for field in fields(message_type):
        default = _default(field, defaults[field.name])
        yield f"{indent}{field.type.label} {field.name}{default}{_comment(field)}"
        if nested := _nested(field):
            yield from _lines(nested, f"{indent}  ")


def _default(field: Field, default: Any) -> str:
    """Return the default; those of nested messages are shown at their fields."""
    return "" if _nested(field) or default == [] else f" = {dump_yaml(default)}"


def _comment(field: Field) -> str:
    return f"  # {field.comment}" if field.comment else ""


def _nested(field: Field) -> type[Any] | None:
    return (field.type.element or field.type).message_type


def _described(message_type: type[Any]) -> dict[str, Any]:
    defaults = plain(message_type())
    return {
        "constants": _constants(message_type),
        "fields": [_described_field(f, defaults[f.name]) for f in fields(message_type)],
    }


def _described_field(field: Field, default: Any) -> dict[str, Any]:
    described: dict[str, Any] = {"name": field.name, "type": field.type.label}
    if nested := _nested(field):
        described |= _described(nested)
    else:
        described["default"] = default
    return described | ({"comment": field.comment} if field.comment else {})


def _constants(message_type: type[Any]) -> dict[str, Any]:
    found = constants(message_type)
    return {name: v[0] if isinstance(v, bytes) else v for name, v in found.items()}
