"""The entry point of the ``rosasync`` command and of ``python -m rosasync``."""

from __future__ import annotations

import sys

__all__ = ["main"]


def main() -> None:
    """Run the command line, or print which extra is missing and exit with 2."""
    try:
        from rosasync.cli.app import app
    except ModuleNotFoundError as error:
        missing = (error.name or "").partition(".")[0]
        if missing not in {"rich", "typer"}:
            raise
        print(f"The rosasync command needs {missing}: pip install 'rosasync[cli]'", file=sys.stderr)
        sys.exit(2)
    app()


if __name__ == "__main__":
    main()
