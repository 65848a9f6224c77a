"""Measures the CPU time, context switches and memory of a process."""

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
    """CPU time in ns and context switches of a process and of the children it waited for."""

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
    """Return the usage of this process so far, with all threads and ended children."""
    both = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return Usage(
        round(sum(used.ru_utime + used.ru_stime for used in both) * 1e9),
        sum(used.ru_nvcsw for used in both),
        sum(used.ru_nivcsw for used in both),
    )


def resident_bytes() -> int:
    """Return the resident memory of this process, after it has released unused memory."""
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize()
