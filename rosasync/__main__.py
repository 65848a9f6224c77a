"""The entry point of the ``rosasync`` command and of ``python -m rosasync``."""

from __future__ import annotations

import importlib.util
import sys

__all__ = ["main"]


def main() -> None:
    """Run the command line, or print which extra is missing and exit with 2."""
    try:
        if missing := [name for name in ("rich", "typer", "yaml") if not _is_installed(name)]:
            print(
                f"The rosasync command needs {missing[0]}: pip install 'rosasync[cli]'",
                file=sys.stderr,
            )
            sys.exit(2)
        from rosasync._cli.app import main as run

        code = run()
    except KeyboardInterrupt:
        code = 130
    sys.exit(code)


def _is_installed(module: str) -> bool:
    try:
        return importlib.util.find_spec(module) is not None
    except ValueError:  # for a module that is not from a file
        return module in sys.modules


if __name__ == "__main__":
    main()
