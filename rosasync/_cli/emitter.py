"""YAML of plain values, in the form of PyYAML's block style.

PyYAML makes an object for every number: 31 s for a message of 6 MB. This writes the same form for
numbers and short texts itself, and asks PyYAML only how to quote other texts.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from typing import Any

import yaml

__all__ = ["UNREADABLE", "dump_yaml"]

UNREADABLE = re.compile(r"[\x7f-\x9f\u2028\u2029\ufeff\ufffe\uffff]")
"""Characters that JSON allows in a text and YAML does not, or takes for the end of a line."""

_Dumper: Any = getattr(yaml, "CSafeDumper", yaml.SafeDumper)
_ONE_LINE = 2**31 - 1
_PLAIN = re.compile(r"[A-Za-z_/][\w/.-]*", re.ASCII)
"""Texts that need no quotes anywhere, unless they are one of `_WORDS`."""
_WORDS = frozenset({"true", "false", "yes", "no", "on", "off", "null", "y", "n"})
_CONTAINERS = frozenset({dict, list})
_CONTROL = re.compile(r"[\x00-\x1f]")


def dump_yaml(value: object) -> str:
    """Return a value as YAML, without the final line break."""
    return "\n".join(_lines(value, ""))


def _quote(text: str) -> str:
    """Return a text as JSON, which YAML reads as well."""
    quoted = json.dumps(text, ensure_ascii=False)
    return UNREADABLE.sub(lambda match: f"\\u{ord(match[0]):04x}", quoted)


def _lines(value: Any, indent: str) -> Iterator[str]:
    if not _is_block(value):
        yield f"{indent}{_inline(value)}"
    elif isinstance(value, dict):
        for name, item in value.items():
            head = f"{indent}{_scalar(name, flow=False)}:"
            if _is_block(item):
                yield head
                # As PyYAML does: the elements of a list are not indented.
                yield from _lines(item, indent if isinstance(item, list) else f"{indent}  ")
            else:
                yield f"{head} {_inline(item)}"
    else:
        for item in value:
            first, *others = _lines(item, f"{indent}  ")
            yield f"{indent}- {first.lstrip(' ')}"
            yield from others


def _is_block(value: Any) -> bool:
    """Return whether a value takes lines of its own: a mapping, or a list with one."""
    if isinstance(value, list):
        return not _CONTAINERS.isdisjoint(map(type, value))
    return isinstance(value, dict) and bool(value)


def _inline(value: Any) -> str:
    if isinstance(value, dict):
        return "{}"
    if not isinstance(value, list):
        return _scalar(value, flow=False)
    if {*map(type, value)} == {int}:
        return str(value)
    return f"[{', '.join(_scalar(item, flow=True) for item in value)}]"


def _scalar(value: Any, *, flow: bool) -> str:
    """Return a scalar; ``flow`` is whether it is an element of a list in one line."""
    if isinstance(value, str):
        return _text(value, flow=flow)
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int):
        return str(value)
    if isinstance(value, float):
        return _float(value)
    return _by_pyyaml(value, flow=flow)


def _float(value: float) -> str:
    text = repr(value)
    if "n" in text:  # nan, inf, -inf
        return f"-.{text[1:]}" if text[0] == "-" else f".{text}"
    # YAML 1.1 takes 1e+20 for a text.
    return text.replace("e", ".0e") if "e" in text and "." not in text else text


def _text(text: str, *, flow: bool) -> str:
    if _PLAIN.fullmatch(text) and text.lower() not in _WORDS:
        return text
    if _CONTROL.search(text) or UNREADABLE.search(text):
        return _quote(text)
    return _by_pyyaml(text, flow=flow)


def _by_pyyaml(value: object, *, flow: bool) -> str:
    options: dict[str, Any] = {"Dumper": _Dumper, "allow_unicode": True, "width": _ONE_LINE}
    if flow:
        return yaml.dump([value], default_flow_style=True, **options).strip()[1:-1]  # type: ignore[no-any-return]
    return yaml.dump(value, **options).removesuffix("\n").removesuffix("\n...")  # type: ignore[no-any-return]
