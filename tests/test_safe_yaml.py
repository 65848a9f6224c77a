"""YAML that is broken or malicious: one kind of error, soon."""

from __future__ import annotations

import random
from pathlib import Path

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from rosasync._core.safe_yaml import (
    MAX_BYTES,
    MAX_DEPTH,
    Event,
    YamlError,
    build,
    events,
    load,
    read_bytes,
)


def bomb(levels: int, width: int = 9) -> str:
    """Return a small document whose aliases stand for width ** levels values."""
    lines = [f"a0: &a0 [{', '.join('x' * width)}]"]
    for level in range(1, levels):
        names = ", ".join([f"*a{level - 1}"] * width)
        lines.append(f"a{level}: &a{level} [{names}]")
    return "\n".join(lines)


def text(event: Event) -> str:
    return str(event.value)


@pytest.mark.parametrize("read", [load, lambda data: build(data, text)])
@pytest.mark.parametrize(
    ("data", "message"),
    [
        (bomb(9), "the aliases of this YAML stand for too much"),
        (f"a: &a {'x' * 10_000}\nb: [{', '.join(['*a'] * 200)}]", "stand for too much"),
        ("&a [*a]", r"\*a refers to no anchor that has ended"),
        ("[*a]", r"\*a refers to no anchor"),
        ("&a x\n---\n*a", "single document|refers to no anchor"),
        ("[" * (MAX_DEPTH + 1), "nested too deeply"),
        ("[" * 100_000, "nested too deeply|not YAML"),
        ("{a: " * 100_000, "nested too deeply|not YAML"),
        (b"a" * (MAX_BYTES + 1), "too large: more than 64 MiB"),
        (b"\0\1\2", "not YAML"),
        (random.Random(1).randbytes(1000), "not YAML"),
        (b"'\xff'", "not YAML"),
        ("\ud800", "not YAML"),
        ("a: [", "this is not YAML: line [12], column [15]: "),
        ("a\n---\nb", "a single document"),
        ("!!python/object/apply:os.getcwd []", "tag"),
        ("? [1]\n: 2", "key"),
    ],
)
def test_what_is_refused(read: object, data: str | bytes, message: str) -> None:
    assert callable(read)
    with pytest.raises(YamlError, match=message) as caught:
        read(data)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "data",
    ["2024-99-99", "!!bool x", "!!int x", "0x_", "!!timestamp x", "!!float x", "!!binary é"],
)
def test_what_does_not_fit_its_tag(data: str) -> None:
    with pytest.raises(YamlError, match="does not fit its tag or its form|not YAML"):
        load(data)


def test_aliases_within_the_limits() -> None:
    assert build("a: &a [x, y]\nb: *a\nc: {d: *a}", text) == {
        "a": ["x", "y"],
        "b": ["x", "y"],
        "c": {"d": ["x", "y"]},
    }
    assert load(bomb(4))["a3"][0][0][0][0] == "x"
    depth = "[" * MAX_DEPTH + "]" * MAX_DEPTH
    assert str(build(depth, text)) == depth


def test_a_text_without_a_document() -> None:
    assert build("", text) is None
    assert load("# nothing") is None


@given(data=st.one_of(st.binary(max_size=200), st.text("[]{}&*!a:, -\n'\"|>%@", max_size=40)))
@example(data="*a")
def test_any_text_is_read_or_a_yaml_error(data: str | bytes) -> None:
    for read in (load, lambda given: build(given, text)):
        try:
            read(data)
        except YamlError as error:
            assert "\n" not in str(error)  # noqa: PT017 - most texts are none


def test_a_file_that_does_not_end() -> None:
    with pytest.raises(YamlError, match="too large"):
        list(events(read_bytes(Path("/dev/zero"))))
