"""Parameter files, read and written by the rules of rcl's parser.

A node that starts with ``--params-file`` reads the file with rcl_yaml_param_parser. The reader here
follows its source (parse.c and namespace.c of rcl 9.2), which is why it is an automaton over
events: what rcl makes of duplicate names, of empty mappings and of nested lists cannot be had in
another way.

It does not call the library, which has no limits, and writes outside its arrays for some malformed
files.
"""

from __future__ import annotations

import math
import re
from bisect import insort
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from rosasync._core.parameter_values import (
    Scalar,
    Value,
    Values,
    Variant,
    is_empty,
    is_subnormal,
    read_plain,
)
from rosasync._core.safe_yaml import Event, YamlError, at, events, import_yaml

__all__ = ["read_file", "write_file"]

KEY: Final = "ros__parameters"

_PART = r"(?:\*\*?|[A-Za-z_][A-Za-z0-9_]*)"
_NODE_NAME = re.compile(rf"/?(?:{_PART}/)*{_PART}")


# Reading


def read_file(data: bytes) -> list[tuple[str, dict[str, Value | None]]]:
    """Return what a parameter file has for each node, in the order of the file.

    Returns:
        The full name of each node, or a pattern, with its parameters; None for a parameter without
        a value.

    Raises:
        YamlError: rcl does not accept it; the message says why.
        ImportError: PyYAML is not installed.
    """
    reader = _Reader(import_yaml())
    # A mistake in the YAML explains more than what it leads to, so it is looked for first.
    for _ in events(data):
        pass
    try:
        for event in events(data):
            reader.take(event)
    except YamlError as error:
        raise YamlError(f"this is not a parameter file: {error}") from None
    return [(f"/{name.removeprefix('/')}", node.values()) for name, node in reader.nodes.items()]


@dataclass(slots=True)
class _Namespace:
    """The names of the mappings around an event, joined; and how many rcl believes there are."""

    separator: str
    name: str = ""
    count: int = 0

    def push(self, name: str) -> None:
        if self.count and not self.name.endswith(self.separator):
            self.name += self.separator
        self.name = self.name + name if self.count else name
        self.count += 1

    def pop(self) -> None:
        # Of a name that has a separator itself, only the last part is taken away.
        if self.separator in self.name:
            self.name = self.name.rpartition(self.separator)[0]
        self.count = max(0, self.count - 1)
        if not self.count:
            self.name = ""


@dataclass(slots=True)
class _Node:
    """The parameters of a node. Two of them may have the same name, as in rcl."""

    names: list[str] = field(default_factory=list)
    variants: list[Variant] = field(default_factory=list)
    _places: dict[str, list[int]] = field(default_factory=dict)

    def find(self, name: str) -> int:
        """Return the place of the first parameter of this name, which is added if there is none."""
        places = self._places.setdefault(name, [])
        if not places:
            places.append(len(self.names))
            self.names.append(name)
            self.variants.append(Variant())
        return places[0]

    def rename(self, place: int, name: str) -> None:
        self._places[self.names[place]].remove(place)
        self.names[place] = name
        insort(self._places.setdefault(name, []), place)

    def values(self) -> dict[str, Value | None]:
        return {
            name: variant.value for name, variant in zip(self.names, self.variants, strict=True)
        }


class _Reader:
    """The automaton of ``parse_file_events`` and ``parse_key``, with the names it has there."""

    def __init__(self, yaml: Any) -> None:
        self.nodes: dict[str, _Node] = {}
        self._values = Values()
        self._is_key = True
        self._is_new_map = False
        self._in_params = False
        self._depth = 0
        self._node_ns = _Namespace("/")
        self._param_ns = _Namespace(".")
        self._node = _Node()
        self._place = 0
        self._actions: dict[type, Callable[[Event], None]] = {
            yaml.ScalarEvent: self._scalar,
            yaml.SequenceStartEvent: self._start_list,
            yaml.SequenceEndEvent: self._end_list,
            yaml.MappingStartEvent: self._start_mapping,
            yaml.MappingEndEvent: self._end_mapping,
            yaml.AliasEvent: self._alias,
        }

    def take(self, event: Event) -> None:
        if (action := self._actions.get(type(event))) is not None:
            action(event)

    def _scalar(self, event: Event) -> None:
        if self._is_key:
            self._key(event)
            self._is_key = False
            return
        if not self._in_params or self._place >= len(self._node.names):
            raise YamlError(f"{at(event)}: expected {KEY} and names of parameters before a value")
        if is_empty(event):
            raise YamlError(f"{at(event)}: it has no value for {self._node.names[self._place]}")
        self._values.put(event, self._node.variants[self._place])
        if not self._values.in_list:
            self._is_key = True

    def _key(self, event: Event) -> None:
        name = event.value.partition("\0")[0]
        if not event.value:
            raise YamlError(f"{at(event)}: there is no key")
        if self._in_params:
            self._parameter(event, name)
        elif name.startswith(KEY):
            self._start_node(event)
        else:
            self._node_ns.push(name)

    def _start_node(self, event: Event) -> None:
        name = self._node_ns.name
        if not self._node_ns.count:
            raise YamlError(f"{at(event)}: there is no name of a node before {KEY}")
        if not _NODE_NAME.fullmatch(name):
            raise YamlError(f"{at(event)}: {name!r} is not the name of a node")
        self._node = self.nodes.setdefault(name, _Node())
        self._node_ns.pop()
        self._in_params = True

    def _parameter(self, event: Event, name: str) -> None:
        if self._is_new_map:
            if self._place >= len(self._node.names):
                raise YamlError(f"{at(event)}: expected names of parameters below {KEY}")
            self._param_ns.name = self._node.names[self._place]
            self._param_ns.count += 1
            self._is_new_map = False
        if not self._param_ns.count:
            self._place = self._node.find(name)
            return
        # The entry that the name of the mapping itself got as a key becomes its first parameter.
        self._place = self._node.find(self._param_ns.name)
        self._node.rename(self._place, f"{self._param_ns.name}.{name}")

    def _start_list(self, event: Event) -> None:
        if self._is_key:
            raise YamlError(f"{at(event)}: a list cannot be a key")
        if not self._in_params:
            raise YamlError(f"{at(event)}: expected {KEY} before a list")
        self._values.start_list()

    def _end_list(self, _: Event) -> None:
        self._values.end_list()
        self._is_key = True

    def _start_mapping(self, _: Event) -> None:
        self._depth += 1
        self._is_key = True
        # The mapping of all the parameters has no name of its own.
        below = self._depth - (self._node_ns.count + 1)
        self._is_new_map = not (self._in_params and below == 2)

    def _end_mapping(self, _: Event) -> None:
        if self._in_params:
            if self._param_ns.count:
                self._param_ns.pop()
            else:
                self._in_params = False
        elif self._depth == self._node_ns.count + 1:
            self._node_ns.pop()
        self._depth -= 1

    def _alias(self, event: Event) -> None:
        raise YamlError(f"{at(event)}: a parameter file has no aliases")


# Writing

_PLAIN = re.compile(r"[A-Za-z_/][A-Za-z0-9_./-]*(?: [A-Za-z0-9_./-]+)*")
DEPTH = 20
"""Names with more parts than this are written in one line."""
_YAML_WORDS = frozenset(["null", "true", "false", "yes", "no", "on", "off", "y", "n"])


def write_file(node: str, values: Mapping[str, Value], left_out: Mapping[str, str]) -> str:
    """Return a parameter file that `read_file`, rcl and readers of YAML 1.1 read alike.

    Args:
        node: the node's full name.
        values: the parameters; no list is empty.
        left_out: parameters that no file can hold, and why; they become a comment.
    """
    lines = [f"# {_text(name)} is left out: {reason}" for name, reason in left_out.items()]
    tree = _nested(sorted(values.items()))
    lines += [f"{_text(node)}:", f"  {KEY}:{'' if tree else ' {}'}", *_mapping(tree, "    ")]
    return "\n".join([*lines, ""])


def _mapping(tree: Mapping[str, Any], indent: str) -> Iterable[str]:
    for name, value in tree.items():
        key = f"{indent}{_text(name)}:"
        if isinstance(value, Mapping):
            yield key
            yield from _mapping(value, f"{indent}  ")
        elif isinstance(value, list):
            yield key
            yield from (f"{indent}- {_write(item)}" for item in value)
        else:
            yield f"{key} {_write(value)}"


def _nested(values: Iterable[tuple[str, Value]]) -> dict[str, Any]:
    """Return nested dicts for sorted names with dots."""
    root: dict[str, Any] = {}
    for name, value in values:
        parts = name.split(".")
        # No key may be empty, and readers bound the depth.
        if all(parts) and len(parts) <= DEPTH:
            _insert(root, name, value)
        else:
            root[name] = value
    return root


def _insert(tree: dict[str, Any], name: str, value: Value) -> None:
    first, dot, rest = name.partition(".")
    inner = tree.setdefault(first, {}) if dot else None
    if isinstance(inner, dict):
        _insert(inner, rest, value)
    else:
        # It has no dot, or its first part is itself a parameter.
        tree[name] = value


def _write(value: Scalar) -> str:
    if isinstance(value, str):
        return _text(value)
    if isinstance(value, float):
        return _number(value)
    return str(value).lower() if isinstance(value, bool) else str(value)


def _number(value: float) -> str:
    if not math.isfinite(value):
        return ".nan" if math.isnan(value) else ".inf" if value > 0 else "-.inf"
    if is_subnormal(value):
        # C reports a decimal number there as out of range, and rcl takes it for a text.
        return value.hex()
    text = repr(value)
    # YAML 1.1 takes 1e+16 for a text.
    return text if "." in text else text.replace("e", ".0e")


def _text(text: str) -> str:
    if _PLAIN.fullmatch(text) and text.lower() not in _YAML_WORDS and read_plain(text) is text:
        return text
    if text.isprintable():
        return "'" + text.replace("'", "''") + "'"
    return '"' + "".join(map(_escaped, text)) + '"'


def _escaped(character: str) -> str:
    if character in '"\\':
        return f"\\{character}"
    return character if character.isprintable() else f"\\U{ord(character):08x}"
