"""What a process has used: CPU time and context switches."""

from __future__ import annotations

import ctypes
import dataclasses
import gc
import resource
from dataclasses import dataclass
from pathlib import Path

__all__ = ["Usage", "resident_bytes", "usage"]


@dataclass(frozen=True)
class Usage:
    """CPU time in ns and context switches, of a process and of the children it has waited for."""

    cpu: int = 0
    voluntary: int = 0
    involuntary: int = 0

    def __sub__(self, other: Usage) -> Usage:
        return Usage(
            self.cpu - other.cpu,
            self.voluntary - other.voluntary,
            self.involuntary - other.involuntary,
        )

    def to_json(self) -> dict[str, int]:
        return dataclasses.asdict(self)


def usage() -> Usage:
    """What this process has used so far, all its threads and ended children included."""
    both = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return Usage(
        round(sum(used.ru_utime + used.ru_stime for used in both) * 1e9),
        sum(used.ru_nvcsw for used in both),
        sum(used.ru_nivcsw for used in both),
    )


def resident_bytes() -> int:
    """The memory this process holds, after giving back what it does not need."""
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize()
