"""``list``, ``type``, ``find``, ``info``, ``nodes``, ``ping``, ``why`` and ``doctor``."""

from __future__ import annotations

from importlib.metadata import version
from pathlib import Path

import pytest

from rosasync._ros.middleware import installed_middlewares
from tests.support.command import DISCOVERY, LAMP, LAMP_TYPE, LOOK, json_lines, rosasync, terminal

PROFILE, OTHER_PROFILE = "FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE"
if not version("rclpy").startswith("7."):
    PROFILE, OTHER_PROFILE = OTHER_PROFILE, PROFILE

pytestmark = [pytest.mark.usefixtures("lamp"), pytest.mark.slow]


def test_list() -> None:
    lines = rosasync("list", "-t").stdout.splitlines()
    assert f"{LAMP} [{LAMP_TYPE}]" in lines
    assert not [line for line in lines if "/_" in line]
    names = [item["name"] for item in json_lines(rosasync("list", "--json", *LOOK).stdout)]
    assert LAMP in names
    assert "/lamp_server/get_parameters" in names


def test_list_hidden() -> None:
    with terminal("serve", "/_hidden/switch", LAMP_TYPE) as server:
        server.wait_for("Ctrl-C ends it")
        done = rosasync("list", "--hidden", "--wait", DISCOVERY)
        assert "/_hidden/switch" in done.stdout.splitlines()
        assert "/_hidden/switch" not in rosasync("list").stdout.splitlines()
        server.interrupt()
        server.end()


def test_type_and_find() -> None:
    assert rosasync("type", LAMP).stdout == f"{LAMP_TYPE}\n"
    assert LAMP in rosasync("find", LAMP_TYPE, *LOOK).stdout.splitlines()
    none = rosasync("find", "nav_msgs/srv/GetMap", "--json")
    assert (none.returncode, none.stdout) == (3, "")
    assert "no service of the type nav_msgs/srv/GetMap" in none.stderr
    wrong = rosasync("find", f"{LAMP_TYPE}l")
    assert (wrong.returncode, wrong.stdout) == (2, "")
    assert f"did you mean '{LAMP_TYPE}'" in wrong.stderr
    missing = rosasync("type", "/lamp/swich", "--timeout", DISCOVERY)
    assert (missing.returncode, missing.stdout) == (3, "")
    assert f"there are {LAMP} ({LAMP_TYPE})" in missing.stderr
    missing = rosasync("info", "/lamp/swich", "--wait", DISCOVERY)
    assert (missing.returncode, missing.stdout) == (3, "/lamp/swich\nservers: 0\nclients: 0\n")
    assert f"there are {LAMP} ({LAMP_TYPE})" in missing.stderr


def test_info_shows_nodes_and_clashes() -> None:
    done = rosasync("info", "/lamp/twice", *LOOK)
    assert done.returncode == 0
    assert "servers: 2" in done.stdout
    assert f"  /lamp_server [{LAMP_TYPE}] reliable" in done.stdout
    assert "clash: 2 servers" in done.stdout
    (server,) = json_lines(rosasync("info", LAMP, "--json", *LOOK).stdout)
    assert server["role"] == "server"
    assert server["node"] == "/lamp_server"
    assert rosasync("info", "/lamp/none").returncode == 3


def test_nodes() -> None:
    # Another process of the tests may have a node of the same name.
    lines = rosasync("nodes", *LOOK).stdout.splitlines()
    assert "/lamp_server" in [line.split()[0] for line in lines]
    found = json_lines(rosasync("nodes", "--json", *LOOK).stdout)
    assert "/lamp_server" in [node["name"] for node in found]


@pytest.mark.parametrize(
    ("arguments", "code", "phases"),
    [
        pytest.param((LAMP,), 0, {"graph": True, "matched": True, "answered": True}, id="node"),
        pytest.param(
            (LAMP, "--request", "data: true"),
            0,
            {"graph": True, "matched": True, "answered": True},
            id="service",
        ),
        pytest.param(("/lamp/none", "--timeout", "1"), 3, {"graph": False}, id="graph"),
        pytest.param(
            (LAMP, "std_srvs/srv/Trigger", "--timeout", DISCOVERY),
            3,
            {"graph": True, "matched": False},
            id="matched",
        ),
        pytest.param(
            ("/lamp/silent", "--request", "{}", "--timeout", DISCOVERY),
            4,
            {"graph": True, "matched": True, "answered": False},
            id="answered",
        ),
    ],
)
def test_ping_stops_in_a_phase(
    arguments: tuple[str, ...], code: int, phases: dict[str, bool]
) -> None:
    done = rosasync("ping", *arguments, "--json")
    assert {line["phase"]: line["ok"] for line in json_lines(done.stdout)} == phases
    assert done.returncode == code


def test_ping_shows_times_on_a_terminal() -> None:
    with terminal("ping", LAMP) as command:
        assert command.end() == 0
    assert [line.split()[0] for line in command.screen.splitlines()[:3]] == [
        "graph",
        "matched",
        "answered",
    ]
    assert " ms " in command.screen


@pytest.mark.parametrize(
    ("arguments", "code", "failed", "todo"),
    [
        pytest.param((LAMP,), 0, [], "", id="fine"),
        pytest.param(("/lamp/swich",), 3, ["name"], f"Did you mean {LAMP}", id="name"),
        pytest.param(
            (LAMP, "std_srvs/srv/Trigger"), 1, ["type"], f"Call it as {LAMP_TYPE}", id="type"
        ),
        pytest.param(("/lamp/twice",), 1, ["servers"], "stop all but one", id="servers"),
    ],
)
def test_why(arguments: tuple[str, ...], code: int, failed: list[str], todo: str) -> None:
    done = rosasync("why", *arguments, "--json", *LOOK)
    checks = json_lines(done.stdout)
    assert [check["check"] for check in checks if check["ok"] is False] == failed
    assert todo in " ".join(check["todo"] for check in checks)
    assert done.returncode == code


def test_why_sees_no_nodes_without_discovery() -> None:
    done = rosasync("why", LAMP, ROS_AUTOMATIC_DISCOVERY_RANGE="OFF")
    assert done.returncode == 3
    assert "no range" in done.stdout
    assert "no nodes" in done.stdout
    assert "ROS_DOMAIN_ID" in done.stdout


def test_doctor() -> None:
    done = rosasync("doctor", "--json")
    checks = {check["check"]: check for check in json_lines(done.stdout)}
    for name in ("python", "rclpy", "middleware", "bridge", "call to itself", "other process"):
        assert checks[name]["ok"] is True, checks[name]
    assert {"domain", "range", "shared memory", "multicast", "profile"} <= set(checks)


def test_doctor_names_a_middleware_that_is_not_there() -> None:
    done = rosasync("doctor", RMW_IMPLEMENTATION="rmw_nowhere_cpp")
    assert done.returncode == 1
    assert "RMW_IMPLEMENTATION=rmw_nowhere_cpp" in done.stdout
    assert installed_middlewares()[0] in done.stdout


def test_doctor_checks_the_profile_of_the_middleware(tmp_path: Path) -> None:
    missing = str(tmp_path / "profile.xml")
    both = {
        "FASTRTPS_DEFAULT_PROFILES_FILE": missing,
        "FASTDDS_DEFAULT_PROFILES_FILE": missing,
    }
    for environ, todo in ((both, "no such file"), ({OTHER_PROFILE: missing}, PROFILE)):
        checks = json_lines(rosasync("doctor", "--json", **environ).stdout)
        (profile,) = [check for check in checks if check["check"] == "profile"]
        assert profile["ok"] is False
        assert todo in profile["todo"]


def test_colour_on_a_terminal_only_and_not_with_no_color() -> None:
    with terminal("why", "/lamp/swich", *LOOK) as command:
        assert command.end() == 3
    assert b"\x1b[" in command.raw
    with terminal("why", "/lamp/swich", *LOOK, NO_COLOR="1") as command:
        assert command.end() == 3
    assert b"\x1b[3" not in command.raw
    assert "Did you mean" in command.screen
    assert "\x1b" not in rosasync("why", "/lamp/swich").stdout


def test_columns_limit_the_width() -> None:
    with terminal("why", "/lamp/swich", COLUMNS="50") as command:
        assert command.end() == 3
    assert max(len(line) for line in command.screen.splitlines()) <= 50


SWITCHED_OFF = ("applies no Fast DDS profile", "does not introduce itself at its start")


@pytest.mark.parametrize(
    ("command", "value", "expected"),
    [
        (("why", LAMP), "OFF", SWITCHED_OFF),
        (("why", LAMP), "on", ("has no effect: only the value off has",)),
        (("doctor",), "off", SWITCHED_OFF),
    ],
)
def test_the_profile_switch_is_explained(
    command: tuple[str, ...], value: str, expected: tuple[str, ...]
) -> None:
    checks = json_lines(rosasync(*command, "--json", ROSASYNC_PROFILE=value).stdout)
    (switch,) = [check for check in checks if check["check"] == "profile switch"]
    assert switch["ok"] is None
    for part in (f"ROSASYNC_PROFILE={value}", *expected):
        assert part in switch["found"]
    assert "Unset ROSASYNC_PROFILE" in switch["todo"]


@pytest.mark.parametrize(
    ("environ", "expected"),
    [
        ({}, "rosasync's own in sessions"),
        ({"ROSASYNC_PROFILE": "off"}, "none: ROSASYNC_PROFILE=off"),
        ({PROFILE: __file__}, f"yours, {__file__}, instead of rosasync's"),
    ],
)
def test_doctor_says_which_profile_is_in_use(environ: dict[str, str], expected: str) -> None:
    checks = json_lines(rosasync("doctor", "--json", **environ).stdout)
    (used,) = [check for check in checks if check["check"] == "profile"]
    assert used["ok"] is None
    assert expected in used["found"]
