"""Pictures of the images of sound alone, in the manner of the paper's figures 8 to 10, and of the volume."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from mpl_toolkits.mplot3d.axes3d import Axes3D
from numpy.typing import NDArray

from echolume_processing.sound_images import Images
from echolume_processing.ultrasonic.raster import Raster
from echolume_processing.ultrasonic.voxels import Volume

DPI = 110
HEIGHTS, LEVELS = "viridis", "magma"
FLOOR_DB = -24.0
SLICES = 6


def draw(images: Images, volume: Volume | None, out: Path) -> list[str]:
    """Draw every picture into a folder; returns the files' names in order."""
    pictures = {
        "fig08_cloud.png": _cloud(images),
        "fig09_interpolated.png": _interpolated(images),
        "fig10_edges.png": _edges(images),
    }
    if volume is not None:
        pictures["volume_projections.png"] = _projections(volume)
        pictures["volume_slices.png"] = _slices(volume)
    for name, figure in pictures.items():
        FigureCanvasAgg(figure).print_png(out / name)
    return list(pictures)


def _limits(images: Images) -> tuple[float, float]:
    low, high = float(images.points["z_mm"].min()), float(images.points["z_mm"].max())
    return low - 2, max(high + 2, low + 10)


def _space(axes: Axes3D, images: Images) -> None:
    (left, right, bottom, top), z_mm = _extent(images.raster), _limits(images)
    axes.set_xlim(left, right)
    axes.set_ylim(bottom, top)
    axes.set_zlim(*z_mm)
    axes.set_box_aspect((1, (top - bottom) / (right - left), 0.35))
    axes.set_xlabel("x / mm")
    axes.set_ylabel("y / mm")
    axes.set_zlabel("z / mm")
    axes.view_init(elev=42, azim=-62)


def _extent(raster: Raster) -> tuple[float, float, float, float]:
    half = 0.5 * raster.pixel_mm
    right = raster.x0_mm + raster.pixel_mm * (raster.columns - 1) + half
    top = raster.y0_mm + raster.pixel_mm * (raster.rows - 1) + half
    return raster.x0_mm - half, right, raster.y0_mm - half, top


def _cloud(images: Images) -> Figure:
    figure = Figure(figsize=(8, 6), dpi=DPI, layout="constrained")
    axes = figure.add_subplot(projection="3d")
    _space(axes, images)
    put = cast("Callable[..., Any]", axes.scatter)  # its annotations leave no room for arrays
    points = images.points
    drawn = put(points["x_mm"], points["y_mm"], points["z_mm"], c=points["z_mm"], cmap=HEIGHTS, s=7.0, linewidths=0)
    figure.colorbar(drawn, ax=axes, shrink=0.6, label="z / mm")
    axes.set_title(f"Contact points by sound: {points.size}")
    return figure


def _show(axes: Axes, image: NDArray[np.generic], raster: Raster, cmap: str, limits: tuple[float, float]) -> Any:
    drawn = axes.imshow(image, origin="lower", extent=_extent(raster), cmap=cmap, vmin=limits[0], vmax=limits[1])
    axes.set_xlabel("x / mm")
    axes.set_ylabel("y / mm")
    return drawn


def _interpolated(images: Images) -> Figure:
    """Heights by all three interpolations, and the gray levels of the chosen one."""
    figure = Figure(figsize=(10, 9), dpi=DPI, layout="constrained")
    panels = figure.subplots(2, 2)
    for axes, (name, heights_mm) in zip(panels.flat, images.heights_mm.items(), strict=False):
        drawn = _show(axes, heights_mm, images.raster, HEIGHTS, _limits(images))
        axes.set_title(f"{name.capitalize()} interpolation")
        figure.colorbar(drawn, ax=axes, shrink=0.8, label="z / mm")
    last = panels[1, 1]
    drawn = _show(last, images.gray, images.raster, "gray", (0, 255))
    last.set_title(
        f"Gray levels, {images.chosen}: {images.scale.resolution_mm:.3g} mm, pixel {images.raster.pixel_mm:g} mm"
    )
    figure.colorbar(drawn, ax=last, shrink=0.8, label="level")
    return figure


def _edges(images: Images) -> Figure:
    """The way from the gray levels to edges in three dimensions."""
    figure = Figure(figsize=(13, 8.6), dpi=DPI, layout="constrained")
    stages = {
        "Gaussian filter": images.smooth,
        "Unsharp filter": images.sharp,
        "Threshold (Otsu)": images.binary,
        "Edges (Canny)": images.edge_pixels,
    }
    for number, (title, image) in enumerate(stages.items(), start=1):
        axes = figure.add_subplot(2, 3, number)
        _show(axes, image, images.raster, "gray", (0, 255))
        axes.set_title(title)
    flat = figure.add_subplot(2, 3, 5)
    _show(flat, images.sharp, images.raster, "gray", (0, 255))
    flat.set_title(f"{len(images.edges)} straight edges (Hough), ends with 2 sigma")
    space = figure.add_subplot(2, 3, 6, projection="3d")
    _space(space, images)
    space.set_title("Edges in 3D")
    for edge in images.edges:
        x, y, z = edge.ends_mm.T
        flat.plot(x, y, color="tab:orange", linewidth=1.5)
        space.plot(x, y, z, color="tab:orange", linewidth=1.5)
        for end, covariance in zip(edge.ends_mm, edge.covariance_mm2, strict=True):
            flat.add_patch(_ellipse(end, covariance))
    flat.set_xlim(*_extent(images.raster)[:2])
    flat.set_ylim(*_extent(images.raster)[2:])
    return figure


def _ellipse(end_mm: NDArray[np.float64], covariance_mm2: NDArray[np.float64]) -> Ellipse:
    """The two-sigma ellipse of an end in the plane of the raster."""
    values, vectors = np.linalg.eigh(covariance_mm2[:2, :2])
    width, height = (4 * float(np.sqrt(v)) for v in values[::-1])
    angle = float(np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1])))
    middle = float(end_mm[0]), float(end_mm[1])
    return Ellipse(middle, width, height, angle=angle, fill=False, color="tab:cyan", linewidth=0.8)


def _decibels(values: NDArray[np.float32], reference: float) -> NDArray[np.float32]:
    return 20 * np.log10(np.maximum(values, 1e-6 * reference) / reference)


def _panel(
    axes: Axes, image: NDArray[np.float32], across: NDArray[np.float64], up: NDArray[np.float64], names: str, title: str
) -> Any:
    right, top = 0.5 * (across[1] - across[0]), 0.5 * (up[1] - up[0]) if len(up) > 1 else 0.5
    extent = across[0] - right, across[-1] + right, up[0] - top, up[-1] + top
    drawn = axes.imshow(image, origin="lower", extent=extent, cmap=LEVELS, vmin=FLOOR_DB, vmax=0)
    axes.set_xlabel(f"{names[0]} / mm")
    axes.set_ylabel(f"{names[1]} / mm")
    axes.set_title(title)
    return drawn


def _projections(volume: Volume) -> Figure:
    """Largest values along each axis, as they are and weighted with the coherence factor."""
    grid = volume.grid
    weighted = (False, True) if volume.coherence is not None else (False,)
    figure = Figure(figsize=(15, 4.4 * len(weighted)), dpi=DPI, layout="constrained")
    panels = figure.subplots(len(weighted), 3, squeeze=False)
    for row, with_coherence in zip(panels, weighted, strict=True):
        values = volume.magnitude(weighted=with_coherence)
        reference = max(float(values.max()), 1e-12)
        name = "Delay-and-sum x coherence" if with_coherence else f"Delay-and-sum ({volume.method})"
        drawn: Any = None
        views = ((0, grid.x_mm, grid.y_mm, "xy"), (1, grid.x_mm, grid.z_mm, "xz"), (2, grid.y_mm, grid.z_mm, "yz"))
        for axes, (axis, across, up, names) in zip(row, views, strict=True):
            found = _decibels(values.max(axis=axis), reference)
            drawn = _panel(axes, found, across, up, names, f"{name}, largest along {'zyx'[axis]}")
        figure.colorbar(drawn, ax=row.tolist(), shrink=0.8, label="dB")
    return figure


def _slices(volume: Volume) -> Figure:
    """Level slices at the heights where most comes back."""
    grid, values = volume.grid, volume.magnitude()
    profile = np.sqrt(np.mean(values.astype(np.float64) ** 2, axis=(1, 2)))
    figure = Figure(figsize=(14, 8.6), dpi=DPI, layout="constrained")
    panels = figure.subplots(2, SLICES // 2)
    shown = _crests(profile)
    for axes in panels.flat[len(shown) :]:
        axes.set_axis_off()
    drawn: Any = None
    for axes, k in zip(panels.flat, shown, strict=False):
        found = _decibels(values[k], max(float(values.max()), 1e-12))
        drawn = _panel(axes, found, grid.x_mm, grid.y_mm, "xy", f"z = {grid.z_mm[k]:.1f} mm")
    figure.colorbar(drawn, ax=panels.ravel().tolist(), shrink=0.7, label="dB")
    return figure


def _crests(profile: NDArray[np.float64]) -> NDArray[np.int64]:
    """The highest local maxima of a profile (n,), in order; what is highest besides where there are too few."""
    padded = np.pad(profile, 1, constant_values=-np.inf)
    crest = (profile > padded[:-2]) & (profile >= padded[2:])
    return np.sort(np.lexsort((-profile, ~crest))[:SLICES])
