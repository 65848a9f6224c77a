"""The checks of ``why`` and ``doctor``, as they are printed."""

from __future__ import annotations

from dataclasses import asdict, dataclass

from rosasync._cli.output import console, print_json

__all__ = ["Check", "Report"]


@dataclass(frozen=True)
class Check:
    """One finding.

    Attributes:
        check: what was looked at.
        ok: whether that is in order; None for a fact that is neither.
        found: what was found.
        todo: what to do about it.
    """

    check: str
    ok: bool | None
    found: str
    todo: str = ""


class Report:
    """Prints each check as it is made, and counts those that failed."""

    def __init__(self, as_json: bool) -> None:
        self._as_json = as_json
        self._console = None if as_json else console()
        self.failed: list[str] = []

    def add(self, check: str, ok: bool | None, found: str, todo: str = "") -> None:
        """Print one check; what to do is printed unless it is in order."""
        made = Check(check, ok, found, "" if ok else todo)
        if ok is False:
            self.failed.append(check)
        if self._console is None:
            print_json(asdict(made))
            return
        mark, style = {True: ("ok", "green"), False: ("no", "bold red"), None: ("-", "")}[ok]
        from rich.text import Text

        self._console.print(Text.assemble((f"{mark:<3}", style), f"{check:<15} {found}"))
        if made.todo:
            self._console.print(Text(f"{'':<19}{made.todo}", style="yellow"))
