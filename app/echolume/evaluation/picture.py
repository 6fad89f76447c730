"""The error map as a picture; drawn without a display."""

from __future__ import annotations

import io

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import Colormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import NDArray

from echolume.evaluation.evaluate import Evaluation
from echolume.evaluation.images import NOT_ASKED, Claimed, Reference
from echolume_messages.plan import MapField
from echolume_messages.types import Label
from echolume_processing.hybrid.ply import LABEL_RGB

DPI = 120
NO_HEIGHT = "#d9d9d9"
TOO_LOW, TOO_HIGH = "#00c2ff", "#ff2bd6"
ANY_RGB = (250, 240, 200)
LIMITS_MM = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)


def picture(map_: Claimed, truth: Reference, field: MapField, found: Evaluation) -> bytes:
    """Signed error, error over sigma, labels and the truth's labels, as PNG."""
    figure = Figure(figsize=(12.5, 12.5), dpi=DPI)
    figure.subplots_adjust(left=0.06, right=0.93, bottom=0.09, top=0.9, wspace=0.36, hspace=0.34)
    (error, ratio), (named, real) = figure.subplots(2, 2)
    off_mm = map_.front_mm - truth.front_mm
    _signed(figure, error, off_mm, field, limit(off_mm), "map minus truth / mm", " mm")
    scores = found["non_edge"]
    error.set_title(
        f"Error of height: F at 1 mm {_text(found['all']['f1_at_1mm'])}, RMSE {_text(found['all']['rmse_mm'])} mm\n"
        f"away from edges: {_text(scores['f1_at_1mm'])}, {_text(scores['rmse_mm'])} mm"
    )
    if map_.sigma_mm is None:
        _absent(ratio, "the map states no sigma")
    else:
        with np.errstate(divide="ignore", invalid="ignore"):
            _signed(figure, ratio, off_mm / np.hypot(map_.sigma_mm, truth.sigma_mm), field, 4.0, "error / sigma", "")
        row = found["consistency"]["non_edge"]
        ratio.set_title(
            f"Error over stated sigma: NEES {_text(row['nees'])}, within 1.96 sigma {_text(row['coverage95'])}\n"
            "(away from edges; 1 and 0.95 if the sigmas hold)"
        )
    _labels(named, map_.label, field, "What the map says", "the map has no labels")
    _labels(real, truth.label, field, "What the truth says", "")
    sources = found["sources"]
    figure.suptitle(f"{sources['map']}{' ' + sources['layer'] if sources['layer'] else ''} against {sources['truth']}")
    drawn = io.BytesIO()
    FigureCanvasAgg(figure).print_png(drawn)
    return drawn.getvalue()


def limit(off_mm: NDArray[np.float64]) -> float:
    """End of the colour scale: a round number that 95 % of the errors are below."""
    size_mm = np.abs(off_mm[np.isfinite(off_mm)])
    most_mm = float(np.percentile(size_mm, 95)) if size_mm.size else 0.0
    return next((step for step in LIMITS_MM if step >= most_mm), LIMITS_MM[-1])


def _signed(
    figure: Figure, axes: Axes, image: NDArray[np.float64], field: MapField, end: float, name: str, unit: str
) -> None:
    """An image of a signed quantity; cells beyond the scale stand out in colours of their own."""
    colours: Colormap = colormaps["RdBu_r"].with_extremes(bad=NO_HEIGHT, under=TOO_LOW, over=TOO_HIGH)
    drawn = axes.imshow(
        np.ma.masked_invalid(image), origin="lower", extent=(*field.x_mm, *field.y_mm), cmap=colours,
        vmin=-end, vmax=end, interpolation="nearest",
    )  # fmt: skip
    figure.colorbar(drawn, ax=axes, fraction=0.046, pad=0.03, label=name, extend="both")
    with np.errstate(invalid="ignore"):
        low, high, none = (float(part.mean()) for part in (image < -end, image > end, np.isnan(image)))
    patches = [
        Patch(color=TOO_HIGH, label=f"above {end:g}{unit}: {100 * high:.2f} %"),
        Patch(color=TOO_LOW, label=f"below {-end:g}{unit}: {100 * low:.2f} %"),
        Patch(color=NO_HEIGHT, label=f"no height: {100 * none:.2f} %"),
    ]
    _legend(axes, patches)


def _labels(axes: Axes, label: NDArray[np.int64] | None, field: MapField, title: str, absent: str) -> None:
    if label is None:
        _absent(axes, absent)
        return
    rgb = LABEL_RGB[np.maximum(label, 0)].copy()
    rgb[label == NOT_ASKED] = ANY_RGB
    axes.imshow(rgb, origin="lower", extent=(*field.x_mm, *field.y_mm), interpolation="nearest")
    axes.set_title(title)
    patches = [
        Patch(
            color=f"#{bytes(LABEL_RGB[kind]).hex()}", label=f"{kind.name.lower()}: {int((label == kind).sum())} cells"
        )
        for kind in Label
        if (label == kind).any()
    ]
    if (label == NOT_ASKED).any():
        patches.append(Patch(color=f"#{bytes(ANY_RGB).hex()}", label=f"any: {int((label == NOT_ASKED).sum())} cells"))
    _legend(axes, patches)


def _legend(axes: Axes, patches: list[Patch]) -> None:
    """Below the image, with the names of the axes."""
    axes.set_xlabel("x / mm")
    axes.set_ylabel("y / mm")
    axes.legend(handles=patches, loc="upper center", bbox_to_anchor=(0.5, -0.1), ncols=3, fontsize=8, frameon=False)


def _absent(axes: Axes, why: str) -> None:
    axes.set_axis_off()
    axes.text(0.5, 0.5, why, transform=axes.transAxes, ha="center", va="center", color="0.4")


def _text(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}" if value < 10 else f"{value:.0f}"
