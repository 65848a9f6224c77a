"""DDS security: a session that is to be secure opens securely, or not at all."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.process import ROOT, own
from tests.support.times import LIMIT

PROGRAM = """
import asyncio
from rosasync import RosasyncError, Session

async def main():
    try:
        async with Session("secure"):
            print("opened")
    except RosasyncError as error:
        print("refused:", "security libraries" in str(error))

asyncio.run(main())
"""


@pytest.mark.parametrize("strategy", ["Enforce", "Permissive"])
def test_without_the_security_libraries_it_does_not_open(tmp_path: Path, strategy: str) -> None:
    """The wheels of Fast DDS are built without them."""
    enclave = tmp_path / "enclaves"
    enclave.mkdir()
    for name in ("identity_ca.cert", "cert", "key", "permissions_ca.cert"):
        (enclave / f"{name}.pem").touch()
    for name in ("governance", "permissions"):
        (enclave / f"{name}.p7s").touch()
    environment = {
        "ROS_SECURITY_ENABLE": "true",
        "ROS_SECURITY_STRATEGY": strategy,
        "ROS_SECURITY_KEYSTORE": str(tmp_path),
    }
    done = subprocess.run(
        (sys.executable, "-c", PROGRAM),
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        cwd=ROOT,
        env=os.environ | environment,
        timeout=4 * LIMIT,
        check=True,
    )
    assert own(done.stdout) == "refused: True\n"
