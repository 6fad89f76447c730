"""The demo's operator: does by the emulated rig's control what a person does by hand when the scan asks for it."""

from __future__ import annotations

from typing import Protocol

from echolume_messages.errors import ConfigError


class Placer(Protocol):
    """What the operator needs of the emulated rig's control."""

    def place_scene(self, name: str, /) -> None:
        """Put a scene on the bench."""
        ...

    def place_board(self, pose: int, /) -> None:
        """Put the calibration board on the bench, in one of its poses."""
        ...


class Operator:
    """Answers the prompts of a plan: ``board N: ...``, ``plate: ...``, ``block: ...``."""

    def __init__(self, placer: Placer) -> None:
        self._placer = placer

    def answer(self, prompt: str) -> None:
        """Do what the prompt asks for.

        Raises
        ------
        ConfigError
            The prompt is none that the emulated rig understands.
        """
        match prompt.partition(":")[0].split():
            case ["board", number] if number.isdecimal():
                self._placer.place_board(int(number))
            case [("plate" | "block") as name]:
                self._placer.place_scene(name)
            case _:
                raise ConfigError(
                    f"plan: the emulated rig cannot follow the prompt {prompt!r}; "
                    "it knows `board N: ...`, `plate: ...` and `block: ...`"
                )
