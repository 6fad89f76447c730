"""Folders of board images: ``leftNN`` and ``rightNN``, and the error published with them."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

from echolume_messages.errors import ConfigError

if TYPE_CHECKING:
    from echolume_messages.types import Frame

IMAGE_NAME = re.compile(r"left(?P<number>.*)\.(?:jpe?g|png|bmp|tiff?)", re.IGNORECASE)
PUBLISHED = re.compile(r"^avg_reprojection_error:\s*(?P<value>[-+.0-9eE]+)\s*$", re.MULTILINE)


def read_pairs(folder: Path) -> tuple[list[str], list[Frame], list[Frame]]:
    """Names and images of the pairs ``leftNN``/``rightNN`` in a folder, in the order of their names."""
    if not folder.is_dir():
        raise ConfigError(f"{folder}: no such folder; give the one with leftNN and rightNN images")
    names: list[str] = []
    images: tuple[list[Frame], list[Frame]] = ([], [])
    for left in sorted(folder.iterdir()):
        found = IMAGE_NAME.fullmatch(left.name)
        if found is None:
            continue
        right = left.with_name("right" + left.name[len("left") :])
        if not right.is_file():
            raise ConfigError(f"{right}: missing; {left.name} has no partner")
        for path, side in ((left, images[0]), (right, images[1])):
            side.append(read_image(path))
        names.append(found["number"])
    if not names:
        raise ConfigError(f"{folder}: no images named leftNN.jpg (png, bmp, tif) with their rightNN")
    return names, *images


def read_image(path: Path) -> Frame:
    """One image in gray."""
    import cv2
    import numpy as np

    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise ConfigError(f"{path}: not an image that can be read")
    return np.asarray(image, dtype=np.uint8)


def published_rms_px(folder: Path) -> float | None:
    """Reprojection error published beside the images in ``left_intrinsics.yml``, or None."""
    path = folder / "left_intrinsics.yml"
    found = PUBLISHED.search(path.read_text(encoding="utf-8")) if path.is_file() else None
    return float(found["value"]) if found is not None else None


def write_pair(folder: Path, number: int, left: Frame, right: Frame) -> None:
    """Write one pair as ``leftNN.png`` and ``rightNN.png``."""
    for side, image in (("left", left), ("right", right)):
        write_image(folder / f"{side}{number:02d}.png", image)


def write_image(path: Path, image: Frame) -> None:
    """Write one image as PNG."""
    import cv2

    try:
        path.write_bytes(cv2.imencode(".png", image)[1].tobytes())
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error.strerror}") from error
