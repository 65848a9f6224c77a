"""The command line, ``rosasync``: one module for each command."""
