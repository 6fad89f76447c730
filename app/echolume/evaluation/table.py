"""An evaluation as text."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from echolume.evaluation.evaluate import Evaluation

SCORES = ("f1_at_0p5mm", "f1_at_1mm", "f1_at_2mm", "rmse_mm", "completeness", "glass_recall", "glass_precision")
CONSISTENCY = ("cells", "nees", "nees_median", "coverage95")


def table(found: Evaluation) -> str:
    """What a person wants to know; ``-`` where nothing supports a figure."""
    return "\n\n".join(part for part in (_head(found), *_parts(found)) if part) + "\n"


def _head(found: Evaluation) -> str:
    sources, cells = found["sources"], found["cells"]
    layer = f", layer {sources['layer']}" if sources["layer"] else ""
    return "\n".join(
        [
            f"Map    {sources['map']}{layer}: digest {sources['digest']}, scan {sources['scan'] or 'unknown'}, "
            f"calibration {sources['calibration'] or 'unknown'}",
            f"Truth  {sources['truth']}: {sources['truth_kind']}",
            f"Cells  {cells['scored']} of {sources['cell_mm']:g} mm, {cells['claimed']} with a height in the map, "
            f"{cells['non_edge']} away from edges",
        ]
    )


def _parts(found: Evaluation) -> Iterable[str]:
    yield _rows(("cells", *SCORES), [(name, *(found[name][key] for key in SCORES)) for name in ("all", "non_edge")])
    labels, confusion = found["labels"], found["confusion"]
    if labels is not None and confusion is not None:
        keys = ("truth", "named", "recall", "precision")
        yield _rows(("label", *keys), [(name, *(row[key] for key in keys)) for name, row in labels.items()])
        yield _rows(
            ("truth is / map says", *next(iter(confusion.values()))),
            [(name, *row.values()) for name, row in confusion.items()],
        )
    yield _reliability(found)
    yield _glass(found)
    rows = found["consistency"]
    sensors = rows["sensors"] or {}
    shares = found["provenance"] or {}
    yield _rows(
        ("error / sigma", *CONSISTENCY, "share"),
        [
            *((name, *(rows[name][key] for key in CONSISTENCY), None) for name in ("all", "non_edge")),
            *((name, *(row[key] for key in CONSISTENCY), shares.get(name)) for name, row in sensors.items()),
        ],
    )
    if shares:
        yield f"Cells with a height that name no sensor: {100 * shares['none']:.2f} %"
    yield from _metrology(found)


def _reliability(found: Evaluation) -> str:
    said = found["reliability"]
    if said is None:
        return ""
    keys = ("cells", "stated", "right")
    return "\n".join(
        [
            f"Labels' probabilities, {said['cells']} cells: {said['right']:.4f} are right, Brier score "
            f"{said['label_brier']:.5f}, calibration error {said['label_ece']:.5f}",
            _rows(
                ("probability", *keys),
                [(f"{row['low']:g} to {row['high']:g}", *(row[key] for key in keys)) for row in said["bins"]],
            ),
        ]
    )


def _glass(found: Evaluation) -> str:
    glass = found["glass"]
    if glass is None:
        return ""
    keys = ("x_mm", "y_mm", "cells", "height_mm", "recall", "error_mm")
    return "\n".join(
        [
            f"Glass height: median error {_cell(glass['median_mm'])} mm, median of its size "
            f"{_cell(glass['median_abs_mm'])} mm; behind it RMSE {_cell(glass['behind_rmse_mm'])} mm",
            _rows(
                ("plate", *keys), [(str(k + 1), *(row[key] for key in keys)) for k, row in enumerate(glass["plates"])]
            ),
        ]
    )


def _metrology(found: Evaluation) -> Iterable[str]:
    made = found["metrology"]
    if made["steps"]:
        keys = ("x_mm", "y_mm", "nominal_mm", "measured_mm", "error_mm", "sigma_mm", "residual_mm", "cells", "sense")
        yield _rows(("step", *keys), [(str(k + 1), *(row[key] for key in keys)) for k, row in enumerate(made["steps"])])
        yield _rows(
            ("steps by sense", "count", "rms_mm", "worst_mm"),
            [(name, row["count"], row["rms_mm"], row["worst_mm"]) for name, row in made["steps_by_sense"].items()],
        )
    if made["flats"]:
        keys = ("x_mm", "y_mm", "label", "sense", "cells", "measured", "flatness_mm", "range_mm", "rms_mm")
        yield f"Flatness, {100 * made['flatness_left_out']:.1f} % of the points left out\n" + _rows(
            ("flat", *keys), [(row["shape"], *(row[key] for key in keys)) for row in made["flats"]]
        )
    if made["spheres"]:
        keys = ("x_mm", "y_mm", "radius_mm", "cells", "form_mm", "size_mm", "sense")
        yield _rows(("sphere", *keys), [(str(k + 1), *(r[key] for key in keys)) for k, r in enumerate(made["spheres"])])
    absent = [name for name in ("steps", "flats", "spheres") if not made[name]]
    if absent:
        yield f"Not in the truth, so without a figure: {', '.join(absent)}"


def _cell(value: object) -> str:
    if value is None:
        return "-"
    return f"{value:.3f}" if isinstance(value, float) else str(value)


def _rows(head: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    text = [list(head), *([_cell(value) for value in row] for row in rows)]
    widths = [max(len(row[k]) for row in text) for k in range(len(head))]
    lines = (
        "  ".join(v.ljust(w) if k == 0 else v.rjust(w) for k, (v, w) in enumerate(zip(row, widths, strict=True)))
        for row in text
    )
    return "\n".join(line.rstrip() for line in lines)
