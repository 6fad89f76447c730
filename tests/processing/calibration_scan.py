"""The records of an emulated calibration scan: boards, and stripes on them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cache

import numpy as np

from echolume_drivers.emulated import board_image
from echolume_drivers.emulated.optics import optical_truth
from echolume_messages import topics
from echolume_messages.bus.message import Message
from echolume_messages.header import Header, Source


@cache
def calibration_records(seed: int, boards: int = 7, upside_down: bool = False) -> tuple[Message, ...]:
    """Camera frames of the passes board-NN and laser-NN in the order of acquisition.

    Parameters
    ----------
    upside_down
        The board lies in the jig the other way round, so that its x runs against the guide.
    """
    return tuple(_records(seed, boards, (-40.0, 40.0), upside_down))


def _records(seed: int, boards: int, guide_mm: Sequence[float], upside_down: bool) -> Iterator[Message]:
    truth, rng = optical_truth(seed), np.random.default_rng(seed)
    half_turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    trigger = 0
    for number, pose in enumerate(board_image.board_poses(seed, boards)):
        board = board_image.board_at(half_turn @ pose if upside_down else pose)
        shots: list[tuple[str, float | None]] = [(f"board-{number:02d}", None)]
        shots += [(f"laser-{number:02d}", x_mm) for x_mm in guide_mm]
        for name, x_mm in shots:
            lit = x_mm is not None
            for side, topic in (("left", topics.CAMERA_LEFT), ("right", topics.CAMERA_RIGHT)):
                frame = board_image.render_board(
                    board, truth, side, x_mm or 0.0, rng, 4e-3 if lit else 8e-3, lit
                )  # fmt: skip
                header = Header(
                    stream=topic.name,
                    seq=trigger,
                    t_ns=trigger,
                    t_wall_ns=trigger,
                    boot="test",
                    scan="calibration",
                    pass_name=name,
                    trigger=trigger,
                    source=Source(x_mm=x_mm, laser_on=lit),
                )
                yield Message(header, topic, frame)
            trigger += 1
