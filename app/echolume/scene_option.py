"""The option ``--scene`` of the commands that put something on the emulated bench."""

from __future__ import annotations

import argparse
from collections.abc import Sequence


class _ListScenes(argparse.Action):
    """Prints the shipped scenes, each with what stands there, and ends."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: str | Sequence[object] | None,
        option_string: str | None = None,
    ) -> None:
        del namespace, values, option_string
        from echolume_drivers.emulated import scene_file

        names = scene_file.shipped_names()
        width = max(map(len, names))
        parser.exit(0, "".join(f"{name:{width}}  {scene_file.shipped(name).about}\n" for name in names))


def add_scene_option(parser: argparse.ArgumentParser) -> None:
    """Add ``--scene`` and ``--list-scenes``."""
    parser.add_argument(
        "--scene",
        default="demo",
        metavar="NAME|FILE.toml",
        help=f"what stands on the bench: {', '.join(_names())}, or a scene file (default demo)",
    )
    parser.add_argument("--list-scenes", nargs=0, action=_ListScenes, help="say what stands in each scene, and end")


def _names() -> list[str]:
    """Names of the shipped scenes, from the package's folder: help must not load the emulated rig."""
    from importlib.resources import files

    found = files("echolume_drivers").joinpath("emulated", "scenes").iterdir()
    return sorted(entry.name.removesuffix(".toml") for entry in found if entry.name.endswith(".toml"))
