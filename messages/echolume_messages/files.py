"""Files that people name on the command line: what is wrong with them is said by name, and nothing is half written."""

from __future__ import annotations

import os
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

from echolume_messages.errors import ConfigError


def read_text(path: Path, what: str) -> str:
    """Text of a UTF-8 file.

    Raises
    ------
    ConfigError
        It is not there, cannot be read, or is no text; the message names it, and `what` was expected of it.
    """
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{path}: cannot read {what}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ConfigError(
            f"{path}: cannot read {what}: byte {error.start} ({error.object[error.start]:#04x}) is not UTF-8 text"
        ) from error


def make_folder(path: Path, option: str = "--out") -> Path:
    """Make a folder for results and see that files can be made in it, before any work is done for them.

    Raises
    ------
    ConfigError
        It cannot be made or written to.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{option} {path}: cannot make this folder: {error.strerror}") from error
    if not os.access(path, os.W_OK | os.X_OK):
        raise ConfigError(f"{option} {path}: no permission to write into this folder")
    return path


def require_place(path: Path, option: str = "--out") -> Path:
    """See that a file can be made at `path`, before any work is done for it.

    Raises
    ------
    ConfigError
        It is a folder, or its folder is missing or cannot be written to.
    """
    if path.is_dir():
        raise ConfigError(f"{option} {path}: is a folder; give the name of a file")
    if not path.parent.is_dir():
        raise ConfigError(f"{option} {path}: there is no folder {path.parent}")
    if not os.access(path.parent, os.W_OK | os.X_OK):
        raise ConfigError(f"{option} {path}: no permission to write into {path.parent}")
    return path


def replace_bytes(path: Path, data: bytes) -> None:
    """Write a file as a whole or not at all: what was there stays until the new one is on the disk.

    Raises
    ------
    OSError
        As the system says.
    """
    with replacing(path) as fresh:
        fresh.write_bytes(data)


@contextmanager
def replacing(path: Path) -> Generator[Path]:
    """A place beside `path` to write a file to; it takes the place of `path` once it is whole and on the disk.

    What was at `path` stays if the block fails; nothing half written is left.

    Raises
    ------
    OSError
        As the system says.
    """
    fresh = path.with_name(f".{path.name}.{os.getpid()}.new")
    try:
        yield fresh
        with fresh.open("rb") as written:
            os.fsync(written.fileno())
        fresh.replace(path)
    finally:
        fresh.unlink(missing_ok=True)
