"""The pictures of a scan, in the manner of the paper's figures 8 to 13; drawn without a display."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import cast

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from mpl_toolkits.mplot3d.axes3d import Axes3D
from numpy.typing import NDArray

from echolume_messages.plan import MapField
from echolume_messages.types import Label, OpticalSource, Structured
from echolume_processing.hybrid.baselines import Baselines
from echolume_processing.hybrid.model import HybridMap, cell_centres_mm
from echolume_processing.hybrid.ply import LABEL_RGB
from echolume_processing.ultrasonic.image import (
    GrayScale,
    Raster,
    edge_segments,
    gaussian,
    segments_to_rig,
    unsharp,
)

MOST_POINTS = 20_000
"""A cloud is thinned to this for drawing."""
HEIGHT_MAP = "viridis"
DPI = 110


def draw(optical: Structured, ultrasonic: Structured, found: HybridMap, others: Baselines, out: Path) -> list[Path]:
    """Draw every picture of a scan into a folder; returns the files in order.

    Parameters
    ----------
    optical, ultrasonic
        ``OPTICAL_POINT`` (n,) and ``ULTRASONIC_POINT`` (m,).
    found
        The hybrid map.
    others
        Maps of each sense alone.
    out
        Folder; made if needed.
    """
    out.mkdir(parents=True, exist_ok=True)
    limits_mm = _limits(found)
    pictures = {
        "fig08_ultrasonic_cloud.png": _cloud(ultrasonic, found.field, limits_mm, "Ultrasound"),
        "fig09_ultrasonic_interpolated.png": _interpolated(others.ultrasonic_mm, found.field, limits_mm),
        "fig10_edges.png": _edges(others.ultrasonic_mm, found.field, limits_mm),
        "fig11_optical_cloud.png": _cloud(
            optical[optical["source"] != OpticalSource.STEREO], found.field, limits_mm, "Active triangulation"
        ),
        "fig12_ultrasonic_surface.png": _surface(
            others.ultrasonic_mm, found.field, limits_mm, "Ultrasonic, nearest interpolation"
        ),
        "fig13_hybrid.png": _hybrid(found, limits_mm),
        "labels.png": _labels(found),
        "heights.png": _heights(found, others, limits_mm),
    }
    paths: list[Path] = []
    for name, figure in pictures.items():
        FigureCanvasAgg(figure).print_png(out / name)
        paths.append(out / name)
    return paths


def _limits(found: HybridMap) -> tuple[float, float]:
    """Heights that the pictures span: the map's own, at least 10 mm."""
    front = found.cells["front_mm"][np.isfinite(found.cells["front_mm"])]
    if not front.size:
        return 0.0, 10.0
    low, high = float(np.percentile(front, 0.5)), float(np.percentile(front, 99.5))
    return low - 2.0, max(high + 2.0, low + 10.0)


def _axes3(figure: Figure, field: MapField, limits_mm: tuple[float, float], title: str) -> Axes3D:
    axes = figure.add_subplot(projection="3d")
    _set_limits(axes, field, limits_mm, title)
    return axes


def _set_limits(axes: Axes3D, field: MapField, limits_mm: tuple[float, float], title: str) -> None:
    axes.set_xlim(*field.x_mm)
    axes.set_ylim(*field.y_mm)
    axes.set_zlim(*limits_mm)
    axes.set_box_aspect((1, (field.y_mm[1] - field.y_mm[0]) / (field.x_mm[1] - field.x_mm[0]), 0.35))
    axes.set_xlabel("x / mm")
    axes.set_ylabel("y / mm")
    axes.set_zlabel("z / mm")
    axes.set_title(title)
    axes.view_init(elev=42, azim=-62)


def _cloud(points: Structured, field: MapField, limits_mm: tuple[float, float], title: str) -> Figure:
    """A point cloud in three dimensions."""
    figure = Figure(figsize=(8, 6), dpi=DPI, layout="constrained")
    axes = _axes3(figure, field, limits_mm, f"{title}: {points.size} points")
    inside = points[
        (points["z_mm"] > limits_mm[0] - 5)
        & (points["z_mm"] < limits_mm[1] + 5)
        & (np.abs(points["x_mm"] - np.mean(field.x_mm)) <= np.ptp(field.x_mm) / 2)
        & (np.abs(points["y_mm"] - np.mean(field.y_mm)) <= np.ptp(field.y_mm) / 2)
    ]
    shown = inside[np.random.default_rng(0).permutation(inside.size)[:MOST_POINTS]]
    share = np.clip((shown["z_mm"] - limits_mm[0]) / (limits_mm[1] - limits_mm[0]), 0, 1)
    _scatter(axes, shown["x_mm"], shown["y_mm"], shown["z_mm"], colormaps[HEIGHT_MAP](share), shown.size < 5000)
    return figure


def _scatter(
    axes: Axes3D,
    x_mm: NDArray[np.floating],
    y_mm: NDArray[np.floating],
    z_mm: NDArray[np.floating],
    colour: NDArray[np.float64],
    few: bool,
) -> None:
    """Points (n,) with a colour each (n, 3 or 4)."""
    put = cast("Callable[..., object]", axes.scatter)  # its annotations leave no room for arrays
    put(x_mm, y_mm, z_mm, c=colour, s=10.0 if few else 2.5, linewidths=0)


def _surface(height_mm: NDArray[np.float64], field: MapField, limits_mm: tuple[float, float], title: str) -> Figure:
    """A height image as a surface."""
    figure = Figure(figsize=(8, 6), dpi=DPI, layout="constrained")
    axes = _axes3(figure, field, limits_mm, title)
    x_mm, y_mm = np.meshgrid(*cell_centres_mm(field))
    axes.plot_surface(
        x_mm, y_mm, np.clip(height_mm, *limits_mm),
        rcount=100, ccount=100, cmap=HEIGHT_MAP, vmin=limits_mm[0], vmax=limits_mm[1], linewidth=0,
    )  # fmt: skip
    return figure


def _image(
    figure: Figure, axes: Axes, image: NDArray[np.floating], field: MapField, limits: tuple[float, float], cmap: str
) -> None:
    drawn = axes.imshow(
        image, origin="lower", extent=(*field.x_mm, *field.y_mm), cmap=cmap, vmin=limits[0], vmax=limits[1]
    )
    axes.set_xlabel("x / mm")
    axes.set_ylabel("y / mm")
    figure.colorbar(drawn, ax=axes, shrink=0.8, label="mm")


def _interpolated(height_mm: NDArray[np.float64], field: MapField, limits_mm: tuple[float, float]) -> Figure:
    """The interpolated ultrasonic map, in colour and as gray levels."""
    figure = Figure(figsize=(11, 4.8), dpi=DPI, layout="constrained")
    left, right = figure.subplots(1, 2)
    _image(figure, left, height_mm, field, limits_mm, HEIGHT_MAP)
    left.set_title("Ultrasonic, nearest interpolation")
    _image(figure, right, height_mm, field, limits_mm, "gray")
    right.set_title("Gray levels")
    return figure


def _edges(height_mm: NDArray[np.float64], field: MapField, limits_mm: tuple[float, float]) -> Figure:
    """Straight edges of the gray-level image by Hough's transform, and back in three dimensions."""
    figure = Figure(figsize=(12, 5.2), dpi=DPI, layout="constrained")
    left = figure.add_subplot(1, 2, 1)
    right = figure.add_subplot(1, 2, 2, projection="3d")
    x_mm, y_mm = cell_centres_mm(field)
    raster = Raster(float(x_mm[0]), float(y_mm[0]), field.cell_mm, *field.shape)
    heights_mm = np.nan_to_num(np.clip(height_mm, *limits_mm), nan=limits_mm[0])
    smooth = unsharp(gaussian(GrayScale(*limits_mm).image(heights_mm), 2.0), 4.0)
    segments = edge_segments(smooth, min_length_px=max(5, field.shape[0] // 12), max_gap_px=8)
    left.imshow(smooth, origin="lower", extent=(*field.x_mm, *field.y_mm), cmap="gray")
    left.set_title(f"{len(segments)} edges on the filtered gray levels")
    left.set_xlabel("x / mm")
    left.set_ylabel("y / mm")
    _set_limits(right, field, limits_mm, "Edges in 3D")
    for (x0, y0, z0), (x1, y1, z1) in segments_to_rig(segments, heights_mm, raster).tolist():
        left.plot([x0, x1], [y0, y1], color="tab:orange", linewidth=1.5)
        right.plot([x0, x1], [y0, y1], [z0, z1], color="tab:orange", linewidth=1.5)
    return figure


def _hybrid(found: HybridMap, limits_mm: tuple[float, float]) -> Figure:
    """The hybrid map: every cell at its front, coloured by its label."""
    figure = Figure(figsize=(9, 6.6), dpi=DPI, layout="constrained")
    axes = _axes3(figure, found.field, limits_mm, "Hybrid image")
    cells = found.cells[np.isfinite(found.cells["front_mm"])]
    shown = cells[(cells["ix"] + cells["iy"]) % 2 == 0]
    x_mm, y_mm = cell_centres_mm(found.field)
    shade = 0.6 + 0.4 * np.clip((shown["front_mm"] - limits_mm[0]) / (limits_mm[1] - limits_mm[0]), 0, 1)
    colour = LABEL_RGB[shown["label"]] / 255.0 * shade[:, None]
    behind = shown[np.isfinite(shown["behind_mm"])]
    pale = np.tile((0.78, 0.88, 0.95), (behind.size, 1))
    _scatter(axes, x_mm[behind["ix"]], y_mm[behind["iy"]], behind["behind_mm"], pale, False)
    _scatter(axes, x_mm[shown["ix"]], y_mm[shown["iy"]], shown["front_mm"], colour, False)
    axes.legend(handles=_legend(), loc="upper left", fontsize="small")
    return figure


def _legend() -> list[Patch]:
    return [Patch(color=f"#{bytes(LABEL_RGB[k]).hex()}", label=k.name.lower()) for k in Label]


def _labels(found: HybridMap) -> Figure:
    """What each cell is."""
    figure = Figure(figsize=(7.6, 5.6), dpi=DPI, layout="constrained")
    axes = figure.subplots()
    image = LABEL_RGB[found.image("label")]
    axes.imshow(image, origin="lower", extent=(*found.field.x_mm, *found.field.y_mm))
    axes.set_xlabel("x / mm")
    axes.set_ylabel("y / mm")
    axes.set_title("What each cell is")
    axes.legend(handles=_legend(), loc="upper left", bbox_to_anchor=(1.01, 1.0), fontsize="small")
    return figure


def _heights(found: HybridMap, others: Baselines, limits_mm: tuple[float, float]) -> Figure:
    """Four maps side by side."""
    figure = Figure(figsize=(11, 9), dpi=DPI, layout="constrained")
    rows = figure.subplots(2, 2)
    maps = {
        "Light alone": others.optical_mm,
        "Sound alone": others.ultrasonic_mm,
        "Union of all points": others.union_mm,
        "Hybrid": found.image("front_mm").astype(np.float64),
    }
    for axes, (title, image) in zip(rows.flat, maps.items(), strict=True):
        _image(figure, axes, image, found.field, limits_mm, HEIGHT_MAP)
        axes.set_title(title)
    return figure
