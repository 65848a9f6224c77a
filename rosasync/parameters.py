"""Parameters of other nodes, over the session's pool.

::

    arm = ParameterClient(session, "/arm")
    await arm.set("speed", 0.5)
    print(await arm.get("speed"))

Values are plain Python values:

=============  ====================================================================
parameter      Python
=============  ====================================================================
bool           bool
integer        int, NumPy's integers; not bool
double         float, NumPy's floats; not int
string         str
byte array     bytes; also bytearray, and a list of single bytes
other arrays   a list; also a tuple, an ``array.array``, a one-dimensional NumPy array
not set        None
=============  ====================================================================

A list of both int and float is a double array. An empty list takes the type that the node has for
the parameter.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping, Sequence, Set
from functools import partial
from typing import TYPE_CHECKING, Any, TypeAlias, overload

import anyio

from rosasync import RosasyncError
from rosasync._core.node_client import NodeClient
from rosasync._core.parameter_files import read_file, write_file
from rosasync._core.parameter_types import (
    ParameterDescriptor,
    ParameterRange,
    ParameterType,
    descriptor_of,
    from_ros,
    is_value,
    to_ros,
    typed_value,
)
from rosasync._core.safe_yaml import YamlError, read_bytes

if TYPE_CHECKING:
    from rosasync import Session
    from rosasync.typing import Timeout

__all__ = [
    "ParameterClient",
    "ParameterDescriptor",
    "ParameterError",
    "ParameterRange",
    "ParameterType",
]

# `ParameterClient.list` hides the built-in one from the annotations in its class.
Names: TypeAlias = list[str]
# Not an Iterable of them, because a single name is one too.
Several: TypeAlias = list[str] | tuple[str, ...] | Set[str]

NOT_DECLARED = "it is not declared, or has no value"
UNKNOWN = "it may have set them, or not"
NO_BYTES = "a parameter file has no byte arrays"
NO_EMPTY = "a parameter file has no empty arrays"


class ParameterError(RosasyncError):
    """A node refused to set parameters, or does not have them, or its answer makes no sense.

    It can be copied and pickled.

    Attributes:
        node_name: the node's full name.
        reasons: the reason for each parameter concerned, by its name.
    """

    def __init__(self, message: str, *, node_name: str, reasons: Mapping[str, str]) -> None:
        super().__init__(message)
        self.node_name = node_name
        self.reasons = dict(reasons)

    def __reduce__(self) -> tuple[Any, ...]:
        # Exceptions are copied from their positional arguments, and these are keywords.
        make = partial(type(self), node_name=self.node_name, reasons=self.reasons)
        return make, self.args, self.__dict__

    @property
    def name(self) -> str:
        """The first of the parameters."""
        return next(iter(self.reasons))

    @property
    def reason(self) -> str:
        """The reason for the first of the parameters."""
        return self.reasons[self.name]


class ParameterClient(NodeClient):
    """Reads and writes the parameters of another node.

    It owns nothing: its calls share the clients of the session's pool. So many of them may be
    awaited at a time, of one node and of many nodes::

        speeds = await asyncio.gather(
            *(ParameterClient(session, name).get("speed") for name in names)
        )

    Each method also raises what `Session.call` raises, such as `ServiceUnavailable` if there is no
    such node, or if it has no parameter services.

    Args:
        session: an open session.
        node_name: the node's name, ``"/arm"``. Relative names are resolved as service names are.
        timeout: seconds for each call, None for no deadline; if left out, the session's. Each
            method takes a ``timeout`` of its own, and the client's is used if that is left out.

    Raises:
        InvalidServiceName: ROS does not allow the name.
        TypeError, ValueError: the timeout does not fit.
        UsageError: the session is not open, or belongs to another loop or thread.
        SessionClosed, ContextShutdown: the session has ended.
    """

    def __init__(self, session: Session, node_name: str, *, timeout: Timeout = ...) -> None:
        super().__init__(
            session, node_name, timeout, "rcl_interfaces/srv/GetParameters", "get_parameters"
        )

    @overload
    async def get(self, names: str, /, *, timeout: Timeout = ...) -> Any: ...

    @overload
    async def get(self, names: Several, /, *, timeout: Timeout = ...) -> dict[str, Any]: ...

    async def get(self, names: str | Several, /, *, timeout: Timeout = ...) -> Any:
        """Return the value of a parameter, or a dict of the values of several.

        Args:
            names: a name, or several.
            timeout: seconds for each call, None for no deadline; if left out, the client's.

        Raises:
            ParameterError: a parameter is not declared, or has no value.
        """
        values = await self._ask_all("GetParameters", "values", names, timeout)
        return _one_or_all(names, self._values(values))

    async def get_all(self, *, timeout: Timeout = ...) -> dict[str, Any]:
        """Return the values of all parameters that have one, by their names.

        Args:
            timeout: seconds for each call, None for no deadline; if left out, the client's.

        Raises:
            ParameterError: a parameter is of an unknown type.
        """
        names = await self.list(timeout=timeout)
        found = self._values(await self._ask("GetParameters", "values", names, timeout))
        return {name: value for name, value in found.items() if value is not None}

    @overload
    async def describe(self, names: str, /, *, timeout: Timeout = ...) -> ParameterDescriptor: ...

    @overload
    async def describe(
        self, names: Several, /, *, timeout: Timeout = ...
    ) -> dict[str, ParameterDescriptor]: ...

    async def describe(self, names: str | Several, /, *, timeout: Timeout = ...) -> Any:
        """Return the descriptor of a parameter, or a dict of the descriptors of several.

        Args:
            names: a name, or several.
            timeout: seconds for each call, None for no deadline; if left out, the client's.

        Raises:
            ParameterError: a parameter is not declared.
        """
        found = await self._ask_all("DescribeParameters", "descriptors", names, timeout)
        return _one_or_all(
            names,
            {name: descriptor_of(one, self._kind(name, one.type)) for name, one in found.items()},
        )

    @overload
    async def types(self, names: str, /, *, timeout: Timeout = ...) -> ParameterType: ...

    @overload
    async def types(
        self, names: Several, /, *, timeout: Timeout = ...
    ) -> dict[str, ParameterType]: ...

    async def types(self, names: str | Several, /, *, timeout: Timeout = ...) -> Any:
        """Return the type of a parameter, or a dict of the types of several.

        Args:
            names: a name, or several.
            timeout: seconds for each call, None for no deadline; if left out, the client's.

        Raises:
            ParameterError: a parameter is not declared.
        """
        wanted = _all_of(names)
        return _one_or_all(names, self._known(wanted, await self._types(wanted, timeout)))

    async def list(self, *prefixes: str, depth: int = 0, timeout: Timeout = ...) -> Names:
        """Return the sorted names of the node's parameters.

        Args:
            prefixes: only names that begin with one of these and a dot, or that are one of them.
            depth: the maximum number of parts of a name, after its prefix; 0 for any.
            timeout: seconds, None for no deadline; if left out, the client's.
        """
        request = {"prefixes": [*prefixes], "depth": depth}
        response = await self._call("ListParameters", request, timeout)
        return sorted(response.result.names)

    @overload
    async def set(self, name: str, value: object, /, *, timeout: Timeout = ...) -> None: ...

    @overload
    async def set(self, values: Mapping[str, object], /, *, timeout: Timeout = ...) -> None: ...

    async def set(
        self, name: str | Mapping[str, object], value: object = ..., /, *, timeout: Timeout = ...
    ) -> None:
        """Set a parameter, ``set("speed", 0.5)``, or several, ``set({"speed": 0.5, "on": True})``.

        Each is set on its own: if one is refused, the others are set. None undeclares a parameter,
        if the node allows that.

        Args:
            name: the parameter's name; or a mapping of names to values.
            value: the value, if a name is given.
            timeout: seconds for each call, None for no deadline; if left out, the client's.

        Raises:
            ParameterError: the node refused one or more of them; it has the reason of each. Or its
                answer does not say which were set; the message says so.
            TypeError: a value is of a type that no parameter has; nothing was set.
            ValueError: a value is out of range; nothing was set.
        """
        values = _assignments(name, value)
        request = await self._request(values, timeout)
        results = (await self._call("SetParameters", request, timeout)).results
        if len(results) != len(values):
            text = f"the node answered with {len(results)} results for {len(values)}; {UNKNOWN}"
            raise self._error(dict.fromkeys(values, text))
        self._check({n: r for n, r in zip(values, results, strict=True) if not r.successful})

    async def set_atomically(
        self, values: Mapping[str, object], /, *, timeout: Timeout = ...
    ) -> None:
        """Set several parameters at once: all of them, or none.

        Args:
            values: the values by the parameters' names.
            timeout: seconds for each call, None for no deadline; if left out, the client's.

        Raises:
            ParameterError: the node refused them, and none was set. ROS does not say which of them
                is the cause, so all have the same reason.
            TypeError: a value is of a type that no parameter has; nothing was set.
            ValueError: a value is out of range; nothing was set.
        """
        request = await self._request(values, timeout)
        result = (await self._call("SetParametersAtomically", request, timeout)).result
        if not result.successful:
            self._check(dict.fromkeys(values, result))

    async def load(
        self,
        file: str | os.PathLike[str],
        *,
        use_wildcard: bool = False,
        timeout: Timeout = ...,
    ) -> dict[str, Any]:
        """Set the parameters that a YAML file has for this node, as ``ros2 param load`` does.

        The file is read by the rules of rcl: each value is the one that a node has if it is started
        with ``--params-file``. Each is set on its own: if one is refused, the others are set. One
        that is refused and has the file's value already, such as a read-only parameter, is no
        error.

        Args:
            file: the file's path.
            use_wildcard: whether to use the entries whose node name has wildcards, such as
                ``/**``. Of two entries for a parameter, the later one in the file counts.
            timeout: seconds for each call, None for no deadline; if left out, the client's.

        Returns:
            The values by the parameters' names.

        Raises:
            ImportError: PyYAML is not installed; the message says how to install it.
            OSError: the file cannot be read.
            ValueError: it is not a parameter file, is larger than 64 MiB, or has no parameters for
                this node.
            ParameterError: as for `set`.
        """
        # A large file takes seconds.
        values = await anyio.to_thread.run_sync(
            _read, os.fspath(file), self._node_name, use_wildcard, abandon_on_cancel=True
        )
        try:
            await self.set(values, timeout=timeout)
        except ParameterError as error:
            current = await self._ask("GetParameters", "values", [*error.reasons], timeout)
            same = {name for name in current if is_value(current[name], values[name])}
            reasons = {name: error.reasons[name] for name in error.reasons if name not in same}
            if reasons:
                raise self._error(reasons) from None
        return values

    async def dump(self, *, timeout: Timeout = ...) -> str:
        """Return the node's parameters as YAML, as ``ros2 param dump`` prints them.

        A node that is started with the file has the same values, of the same types. Parameters
        without a value are left out. So are byte arrays and empty arrays, which rcl cannot read: a
        comment on top of the file names them.

        Args:
            timeout: seconds for each call, None for no deadline; if left out, the client's.

        Raises:
            ParameterError: a parameter is of an unknown type.
        """
        values = await self.get_all(timeout=timeout)
        left_out = {name: NO_EMPTY for name, value in values.items() if value == []}
        for name, value in values.items():
            if isinstance(value, bytes):
                left_out[name] = f"{NO_BYTES}; it is {[*value]}"
        kept = {name: value for name, value in values.items() if name not in left_out}
        return write_file(self._node_name, kept, left_out)

    async def _call(self, service: str, request: Mapping[str, Any], timeout: Timeout) -> Any:
        name = re.sub("(?<=[a-z])([A-Z])", r"_\1", service).lower()
        return await self._call_node(f"rcl_interfaces/srv/{service}", name, request, timeout)

    async def _ask_all(
        self, service: str, field: str, names: str | Several, timeout: Timeout
    ) -> dict[str, Any]:
        """As `_ask`, but all the names must be known."""
        wanted = _all_of(names)
        return self._known(wanted, await self._ask(service, field, wanted, timeout))

    def _known(self, names: Iterable[str], found: dict[str, Any]) -> dict[str, Any]:
        missing = [name for name in names if name not in found]
        if missing:
            raise self._error(dict.fromkeys(missing, NOT_DECLARED))
        return found

    async def _types(self, names: Sequence[str], timeout: Timeout) -> dict[str, ParameterType]:
        """Return the types of those that are declared."""
        if not names:
            return {}
        # An rclpy node that allows undeclared parameters raises an exception, and ends, if it is
        # asked for the type of one.
        declared = {*await self.list(*names, timeout=timeout)}
        known = [name for name in names if name in declared]
        types = await self._ask("GetParameterTypes", "types", known, timeout)
        found = {name: self._kind(name, number) for name, number in types.items()}
        # One that is declared with a type, and has no value yet.
        unset = [name for name, kind in found.items() if kind is ParameterType.NOT_SET]
        described = await self._ask("DescribeParameters", "descriptors", unset, timeout)
        return found | {name: self._kind(name, one.type) for name, one in described.items()}

    async def _ask(
        self, service: str, field: str, names: Sequence[str], timeout: Timeout
    ) -> dict[str, Any]:
        """Return what the node says about each name that it knows."""
        if not names:
            return {}
        answers = getattr(await self._call(service, {"names": names}, timeout), field)
        if len(answers) == len(names):
            return dict(zip(names, answers, strict=True))
        if len(answers) > len(names):
            text = f"the node answered with {len(answers)} {field} for {len(names)}"
            raise self._error(dict.fromkeys(names, text))
        # A node does not say which of the names it does not know.
        if len(names) == 1:
            return {}
        half = len(names) // 2
        known = await self._ask(service, field, names[:half], timeout)
        return known | await self._ask(service, field, names[half:], timeout)

    async def _request(self, values: Mapping[str, object], timeout: Timeout) -> dict[str, Any]:
        """Return the request that sets these values."""
        typed = {name: typed_value(name, value) for name, value in values.items()}
        empty = [name for name, (kind, _) in typed.items() if kind is None]
        kinds = await self._types(empty, timeout)
        for name in empty:
            typed[name] = self._array_type(name, kinds.get(name)), typed[name][1]
        return {
            "parameters": [
                {"name": name, "value": to_ros(kind, value)}
                for name, (kind, value) in typed.items()
            ]
        }

    def _array_type(self, name: str, kind: ParameterType | None) -> ParameterType:
        if kind is not None and kind.is_array:
            return kind
        raise TypeError(
            f"{name!r}: the type of an empty list is unknown, because {self._node_name} has no "
            "array of this name: give a list that is not empty, or b'' for a byte array"
        )

    def _values(self, found: Mapping[str, Any]) -> dict[str, Any]:
        """Return the values of ``rcl_interfaces/msg/ParameterValue`` messages."""
        return {
            name: from_ros(message, self._kind(name, message.type))
            for name, message in found.items()
        }

    def _kind(self, name: str, number: int) -> ParameterType:
        try:
            return ParameterType(number)
        except ValueError:
            reason = f"the node gives it the type {number}, which is not known"
            raise self._error({name: reason}) from None

    def _check(self, refused: Mapping[str, Any]) -> None:
        if refused:
            raise self._error(
                {name: result.reason or "no reason given" for name, result in refused.items()}
            )

    def _error(self, reasons: Mapping[str, str]) -> ParameterError:
        by_reason: dict[str, list[str]] = {}
        for name, reason in reasons.items():
            by_reason.setdefault(reason, []).append(repr(name))
        details = "; ".join(f"{', '.join(names)}: {reason}" for reason, names in by_reason.items())
        return ParameterError(
            f"{self._node_name}: {details}", node_name=self._node_name, reasons=reasons
        )


def _all_of(names: str | Several) -> list[str]:
    return [names] if isinstance(names, str) else [*names]


def _one_or_all(names: str | Several, found: dict[str, Any]) -> Any:
    return found[names] if isinstance(names, str) else found


def _assignments(name: str | Mapping[str, object], value: object) -> Mapping[str, object]:
    if isinstance(name, str) and value is not ...:
        return {name: value}
    if isinstance(name, Mapping) and value is ...:
        return name
    raise TypeError('give a name and a value, set("speed", 0.5), or a mapping: set({"speed": 0.5})')


def _read(file: str, node_name: str, use_wildcard: bool) -> dict[str, Any]:
    """Return the parameters that a file has for a node."""
    try:
        entries = read_file(read_bytes(file))
    except YamlError as error:
        raise ValueError(f"{file}: {error}") from None
    if not entries:
        raise ValueError(f"{file} is not a parameter file: no node in it has ros__parameters")
    fitting = [(name, values) for name, values in entries if _matches(name, node_name)]
    chosen = [values for name, values in fitting if use_wildcard or name == node_name]
    if not chosen:
        names = ", ".join(dict.fromkeys(name for name, _ in entries))
        hint = "; use_wildcard uses the wildcards" if fitting else ""
        raise ValueError(f"{file} has no parameters for {node_name}, only for {names}{hint}")
    merged = {name: value for values in chosen for name, value in values.items()}
    empty = [name for name, value in merged.items() if value is None]
    if empty:
        raise ValueError(
            f"{file} has no value for {', '.join(empty)}: rcl reads no empty lists and mappings"
        )
    return merged


def _matches(pattern: str, node_name: str) -> bool:
    """Return whether a name matches: ``*`` is any one part of it, ``**`` any number of parts."""
    wild = {"**": "(/[^/]+)*", "*": "/[^/]+"}
    parts = (wild.get(part, "/" + re.escape(part)) for part in pattern.split("/")[1:])
    return re.fullmatch("".join(parts), node_name) is not None
