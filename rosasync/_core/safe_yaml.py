"""YAML from users and files, read within limits, with one kind of error.

Everything that reads YAML here reads it through this module. Its limits are
`MAX_BYTES`, `MAX_DEPTH` and `MAX_ALIASED`: a document beyond them is refused before it takes much
time or memory. PyYAML is imported when it is needed.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from typing import Any, Final, TypeAlias

__all__ = [
    "MAX_ALIASED",
    "MAX_BYTES",
    "MAX_DEPTH",
    "STRING_TAG",
    "Event",
    "YamlError",
    "at",
    "build",
    "events",
    "import_yaml",
    "load",
    "read_bytes",
]

MAX_BYTES: Final = 64 * 1024 * 1024
"""The size of a document or file, in bytes."""
MAX_DEPTH: Final = 100
"""How deeply lists and mappings may be nested."""
MAX_ALIASED: Final = 1_000_000
"""How much all the aliases of a document may repeat, in values and their characters."""

STRING_TAG: Final = "tag:yaml.org,2002:str"

Event: TypeAlias = Any
"""One of PyYAML's events."""


class YamlError(ValueError):
    """A text that is not YAML, or beyond the limits; the message is one line."""


def import_yaml() -> Any:
    """Import PyYAML.

    Raises:
        ImportError: it is not installed; the message says how to install it.
    """
    try:
        import yaml
    except ImportError as error:
        raise ImportError(
            f"YAML needs PyYAML, which cannot be imported here ({error}): "
            "pip install 'rosasync[cli]'"
        ) from error
    return yaml


def read_bytes(file: str | os.PathLike[str]) -> bytes:
    """Read a file for `events`. It reads no more than what shows that the file is too large.

    Raises:
        OSError: the file cannot be read.
    """
    with open(file, "rb") as opened:
        return opened.read(MAX_BYTES + 1)


def events(text: str | bytes) -> Iterator[Event]:
    """Yield the events of a text, from the start of the stream to its end.

    Args:
        text: a text; or bytes in UTF-8, or in UTF-16 with a byte order mark.

    Raises:
        YamlError: it is not YAML, or beyond the limits.
        ImportError: PyYAML is not installed.
    """
    yaml = import_yaml()
    if len(text) > MAX_BYTES:
        raise YamlError(f"this YAML is too large: more than {MAX_BYTES // 1024**2} MiB")
    limits = _Limits(yaml)
    try:
        # libyaml decodes bytes as the programs in C that read the same file.
        for event in yaml.parse(text, _fastest(yaml)):
            limits.check(event)
            yield event
    except yaml.YAMLError as error:
        raise YamlError(f"this is not YAML: {_line_of(error)}") from None
    except UnicodeError as error:
        raise YamlError(f"this is not YAML: {error}") from None


def build(text: str | bytes, scalar: Callable[[Event], Any]) -> Any:
    """Return the value of a text's only document, None if it has none.

    Lists and mappings become lists and dicts. An alias is the same object as its anchor.

    Args:
        text: as for `events`.
        scalar: returns the value of a scalar.

    Raises:
        YamlError: as for `events`; or more than one document, a tag or a key that is not supported.
    """
    builder = _Builder(import_yaml(), scalar)
    for event in events(text):
        builder.take(event)
    return builder.root


def load(text: str | bytes) -> Any:
    """Return the value of a text's only document by the rules of YAML 1.1, which PyYAML writes.

    Raises:
        YamlError: as for `events`; or a value does not fit its tag.
    """
    yaml = import_yaml()
    documents = sum(isinstance(event, yaml.DocumentStartEvent) for event in events(text))
    if documents > 1:
        raise YamlError(f"expected a single document, got {documents}")
    try:
        return yaml.load(text, _fastest(yaml))
    except yaml.YAMLError as error:
        raise YamlError(f"this is not YAML: {_line_of(error)}") from None
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        # PyYAML's constructors raise whatever int, date and the like raise: 2024-99-99, !!bool x.
        raise YamlError(f"a value does not fit its tag or its form: {error}") from None


def _fastest(yaml: Any) -> Any:
    return getattr(yaml, "CSafeLoader", yaml.SafeLoader)


def _line_of(error: Any) -> str:
    mark = getattr(error, "problem_mark", None)
    what = getattr(error, "problem", None)
    if mark is None or what is None:
        return " ".join(str(error).split())
    return f"line {mark.line + 1}, column {mark.column + 1}: {what}"


def at(event: Event) -> str:
    """Return the place of an event, for an error."""
    return f"line {event.start_mark.line + 1}, column {event.start_mark.column + 1}"


class _Limits:
    """Counts what the aliases of a document stand for, and the depth.

    A few hundred bytes of aliases can stand for more than any memory holds. Code that walks
    over the value afterwards visits all of it.
    """

    def __init__(self, yaml: Any) -> None:
        self._yaml = yaml
        self._sizes: dict[str, int] = {}
        self._aliased = 0
        # The sizes and anchors of the collections around the present event, the document included.
        self._open: list[tuple[int, str | None]] = []
        self._size = 0

    def check(self, event: Event) -> None:
        yaml = self._yaml
        if isinstance(event, yaml.ScalarEvent):
            self._add(1 + len(event.value), event.anchor)
        elif isinstance(event, yaml.AliasEvent):
            self._alias(event)
        elif isinstance(event, yaml.CollectionStartEvent):
            if len(self._open) == MAX_DEPTH:
                raise YamlError(f"this YAML is nested too deeply, by more than {MAX_DEPTH} levels")
            self._open.append((self._size, event.anchor))
            self._size = 1
        elif isinstance(event, yaml.CollectionEndEvent):
            size = self._size
            self._size, anchor = self._open.pop()
            self._add(size, anchor)
        elif isinstance(event, yaml.DocumentStartEvent):
            self._sizes.clear()

    def _alias(self, event: Event) -> None:
        size = self._sizes.get(event.anchor)
        if size is None:
            raise YamlError(f"{at(event)}: *{event.anchor} refers to no anchor that has ended")
        self._aliased += size
        if self._aliased > MAX_ALIASED:
            raise YamlError(f"{at(event)}: the aliases of this YAML stand for too much")
        self._size += size

    def _add(self, size: int, anchor: str | None) -> None:
        self._size += size
        if anchor is not None:
            self._sizes[anchor] = size


class _Builder:
    """Makes values of events."""

    _TAGS = (None, "!", "tag:yaml.org,2002:map", "tag:yaml.org,2002:seq")

    def __init__(self, yaml: Any, scalar: Callable[[Event], Any]) -> None:
        self.root: Any = None
        self._yaml = yaml
        self._scalar = scalar
        self._anchors: dict[str, Any] = {}
        self._open: list[_List | _Mapping] = []
        self._documents = 0

    def take(self, event: Event) -> None:
        yaml = self._yaml
        if isinstance(event, yaml.ScalarEvent):
            self._add(event, self._scalar(event))
        elif isinstance(event, yaml.AliasEvent):
            self._put(event, self._anchors[event.anchor])
        elif isinstance(event, yaml.CollectionStartEvent):
            self._start(event)
        elif isinstance(event, yaml.CollectionEndEvent):
            self._open.pop()
        elif isinstance(event, yaml.DocumentStartEvent):
            self._documents += 1
            if self._documents > 1:
                raise YamlError(f"{at(event)}: expected a single document")

    def _start(self, event: Event) -> None:
        if event.tag not in self._TAGS:
            raise YamlError(f"{at(event)}: the tag {event.tag} is not supported here")
        inner = _Mapping() if isinstance(event, self._yaml.MappingStartEvent) else _List()
        self._add(event, inner.value)
        self._open.append(inner)

    def _add(self, event: Event, value: Any) -> None:
        if event.anchor is not None:
            self._anchors[event.anchor] = value
        self._put(event, value)

    def _put(self, event: Event, value: Any) -> None:
        if not self._open:
            self.root = value
        elif not self._open[-1].put(value):
            raise YamlError(f"{at(event)}: a key has to be a text or a number")


class _List:
    """A list that is being built."""

    def __init__(self) -> None:
        self.value: list[Any] = []

    def put(self, value: Any) -> bool:
        self.value.append(value)
        return True


class _Mapping:
    """A mapping that is being built."""

    def __init__(self) -> None:
        self.value: dict[Any, Any] = {}
        self._key: Any = self

    def put(self, value: Any) -> bool:
        """Take a key, or the value for the last key; return False for what cannot be a key."""
        if self._key is not self:
            self.value[self._key] = value
            self._key = self
        elif isinstance(value, list | dict):
            return False
        else:
            self._key = value
        return True
