"""The demo's plans, which ship with the program."""

from __future__ import annotations

from importlib.resources import files


def plan_text(name: str) -> str:
    """TOML text of a plan that ships with the program: ``demo`` or ``calibrate``."""
    return files("echolume").joinpath("plans", f"{name}.toml").read_text(encoding="utf-8")
