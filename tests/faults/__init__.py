"""Faults, each with the figures that its calls must show: `python -m pytest -m faults`."""
