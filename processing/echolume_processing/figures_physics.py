"""The paper's pictures of sound itself, figures 2, 3, 5 and 6 and Table I, from equations alone; without a display."""

from __future__ import annotations

from pathlib import Path
from typing import cast

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.projections.polar import PolarAxes
from numpy.typing import NDArray

from echolume_processing.ultrasonic import acoustics
from echolume_processing.ultrasonic.contact import fit_plane, plane_contacts
from echolume_processing.ultrasonic.plate_energy import plate_echoes, plate_energy
from echolume_processing.ultrasonic.table_one import ANGLES_RAD, TABLE_I, TableFit

DPI = 110
WAVELENGTH_MM = 8.58
"""Of 40 kHz in air of 20 degrees; the paper names neither."""
FLOOR_DB = -40.0
FINITE_MM = 200.0
PLATE_MM = 200.0
APART_MM = 100.0
PLATE_MAP = "turbo"
LINES = ("tab:blue", "tab:orange", "tab:green")


def draw(plain: TableFit, with_cross_talk: TableFit, out: Path) -> list[Path]:
    """Draw all of them into a folder that exists; returns the files in order.

    Parameters
    ----------
    plain, with_cross_talk : TableFit
        Table I from one radius, and with a level of cross-talk.
    out : Path
    """
    wavenumber = 2 * np.pi / WAVELENGTH_MM
    radius_mm = plain.wavenumber_radius / wavenumber
    pictures = {
        "fig02_axis.png": _axis(wavenumber, radius_mm),
        "fig03_beam.png": _beam(wavenumber, radius_mm),
        "fig05_contacts.png": _contacts(),
        "fig06_energy.png": _energy(with_cross_talk),
        "table1.png": _table(plain, with_cross_talk),
    }
    paths: list[Path] = []
    for name, figure in pictures.items():
        FigureCanvasAgg(figure).print_png(out / name)
        paths.append(out / name)
    return paths


def _axis(wavenumber: float, radius_mm: float) -> Figure:
    """Pressure on the axis of the paper's transducer, and of one ten times as wide, which has a near field to show."""
    figure = Figure(figsize=(11, 4.4), dpi=DPI, layout="constrained")
    for axes, radius in zip(figure.subplots(1, 2), (radius_mm, 10 * radius_mm), strict=True):
        near_mm = acoustics.near_field_mm(wavenumber, radius)
        far_mm = acoustics.far_field_mm(wavenumber, radius)
        digits = 1 if near_mm < 10 else 0
        near, far = f"near field, to {near_mm:.{digits}f} mm", f"far field, from {far_mm:.{digits}f} mm"
        z_mm = np.geomspace(0.05 * radius, 4 * far_mm, 1500)
        axes.plot(z_mm, acoustics.axial_pressure(z_mm, wavenumber, radius), color="0.25", label="equation 6")
        few_mm = np.geomspace(0.05 * radius, 4 * far_mm, 40)
        points_mm = np.column_stack([np.zeros((40, 2)), few_mm])
        pressure = np.abs(acoustics.rayleigh_pressure(points_mm, wavenumber, radius))
        axes.plot(few_mm, pressure, "o", ms=4, mfc="none", color="tab:orange", label="equation 5")
        law = 0.5 * wavenumber * radius**2 / z_mm
        axes.plot(z_mm[law < 2.2], law[law < 2.2], ":", color="tab:blue", label="far law $k R^2 / 2r$")
        axes.axvspan(z_mm[0], near_mm, color="tab:red", alpha=0.12, lw=0, label=near)
        axes.axvspan(far_mm, z_mm[-1], color="tab:blue", alpha=0.1, lw=0, label=far)
        axes.set_xscale("log")
        axes.set_xlim(z_mm[0], z_mm[-1])
        axes.set_ylim(0, 2.9)
        axes.set_xlabel("distance r / mm")
        axes.set_ylabel(r"pressure / $\rho c U_0$")
        axes.set_title(f"Disk of radius {radius:.1f} mm, k R = {wavenumber * radius:.1f}")
        axes.legend(fontsize="small", loc="upper center", ncols=2)
    return figure


def _beam(wavenumber: float, radius_mm: float) -> Figure:
    """The beam in polar coordinates: equation 7, and equation 5 at a finite distance."""
    figure = Figure(figsize=(7.4, 5.0), dpi=DPI)
    # The half circle fills half the height of the square that axes of a whole circle would take.
    axes = cast("PolarAxes", figure.add_axes((0.06, -0.17, 0.88, 1.4), projection="polar"))
    angle_rad = np.radians(np.linspace(-89.5, 89.5, 1433))
    kr = wavenumber * radius_mm
    far = np.abs(acoustics.directivity(kr * np.sin(angle_rad)))
    points_mm = FINITE_MM * np.column_stack([np.sin(angle_rad), np.zeros(angle_rad.shape), np.cos(angle_rad)])
    near = np.abs(acoustics.rayleigh_pressure(points_mm, wavenumber, radius_mm))
    axes.plot(angle_rad, _db(far), color="tab:blue", lw=2, label="equation 7, far away")
    at = f"equation 5 at {FINITE_MM:.0f} mm"
    axes.plot(angle_rad, _db(near / near.max()), "--", color="tab:orange", label=at)
    half_rad, zero_rad = acoustics.half_angle_rad(kr), acoustics.first_zero_rad(kr)
    for edge_rad, style, name in ((half_rad, "-.", "-6 dB"), (zero_rad, ":", "first zero")):
        label = f"{name} at {np.degrees(edge_rad):.1f}°"
        for side in (-1, 1):
            axes.plot([side * edge_rad] * 2, [FLOOR_DB, 0], style, color="0.4", lw=1, label=label)
            label = None
    axes.set_theta_zero_location("N")
    axes.set_theta_direction(-1)
    axes.set_thetamin(-90)
    axes.set_thetamax(90)
    axes.set_rlim(FLOOR_DB, 0)
    axes.set_rticks([-40, -30, -20, -10, 0], ["-40", "-30", "-20", "-10", "0 dB"])
    figure.suptitle(f"Beam of a disk, k R = {kr:.2f} (R = {radius_mm:.2f} mm at 40 kHz)")
    figure.legend(loc="lower center", ncols=2, fontsize="small")
    return figure


def _db(share: NDArray[np.float64]) -> NDArray[np.float64]:
    return 20 * np.log10(np.maximum(share, 10 ** (FLOOR_DB / 20)))


def _contacts() -> Figure:
    """Contact points of both receivers' echoes, triangulated, on a plate that turns from -45 to 45 degrees."""
    figure = Figure(figsize=(8.4, 6.4), dpi=DPI, layout="constrained")
    axes = figure.subplots()
    receivers_mm = np.array([[-0.5 * APART_MM, 0.0, 0.0], [0.5 * APART_MM, 0.0, 0.0]])
    paths_mm = plate_echoes(ANGLES_RAD, PLATE_MM, APART_MM, 1.0).paths_mm
    colours = colormaps[PLATE_MAP](np.linspace(0, 1, len(ANGLES_RAD)))
    both = np.array([True, True])
    for k, angle_rad in enumerate(ANGLES_RAD.tolist()):
        plane = fit_plane(receivers_mm, paths_mm[:, k], both)
        if plane is None:
            raise ValueError(f"a plate turned by {angle_rad} rad has no plane; that cannot be")
        points_mm = plane_contacts(plane, receivers_mm)
        if k % 15 == 0:
            along = np.array([np.cos(angle_rad), np.sin(angle_rad)])
            ends = np.array([0.0, PLATE_MM]) + np.outer([-190.0, 190.0], along)
            axes.plot(*ends.T, color=colours[k], lw=1.2, alpha=0.7)
            for receiver_mm, point_mm in zip(receivers_mm, points_mm, strict=True):
                ray = np.array([[0.0, 0.0], point_mm[[0, 2]], receiver_mm[[0, 2]]])
                axes.plot(*ray.T, color=colours[k], lw=0.8, ls=":")
        if k % 3 == 0:
            for point_mm, marker in zip(points_mm, "<>", strict=True):
                axes.plot(point_mm[0], point_mm[2], marker, color=colours[k], ms=7, mec="0.2", mew=0.4, zorder=3)
    axes.plot(*receivers_mm[:, [0, 2]].T, "s", color="0.2", ms=8)
    axes.plot(0, 0, "o", color="0.2", ms=9)
    for x_mm, name in ((-0.5 * APART_MM, "R"), (0.0, "E"), (0.5 * APART_MM, "R")):
        axes.annotate(name, (x_mm, 0), (0, -16), textcoords="offset points", ha="center")
    for marker, name in (("<", "left receiver"), (">", "right receiver")):
        axes.plot([], [], marker, color="0.6", mec="0.2", label=f"contact, {name}")
    axes.legend(loc="upper center", fontsize="small", ncols=2)
    axes.set_aspect("equal")
    axes.set_xlim(-190, 190)
    axes.set_ylim(-28, 345)
    axes.set_xlabel("x / mm")
    axes.set_ylabel("z / mm")
    axes.set_title(f"Contact points on a turned plate, R-E-R {APART_MM:.0f} mm apart, {PLATE_MM:.0f} mm before it")
    scale = ScalarMappable(Normalize(-45, 45), PLATE_MAP)
    figure.colorbar(scale, ax=axes, shrink=0.75, label="angle of the plate / °", ticks=np.arange(-45, 46, 15))
    return figure


def _energy(found: TableFit) -> Figure:
    """Energy over the plate's angle for every row of Table I: ours, its Gaussian and the paper's, offsets taken out."""
    figure = Figure(figsize=(11, 8), dpi=DPI, layout="constrained")
    degrees = np.degrees(ANGLES_RAD)
    for number, axes in enumerate(figure.subplots(2, 2, sharex=True, sharey=True).flat):
        first = 3 * number
        for k, colour in zip(range(first, first + 3), LINES, strict=True):
            distance_mm, separation_mm, a, _, c_deg = TABLE_I[k]
            energy = plate_energy(ANGLES_RAD, distance_mm, separation_mm, found.wavenumber_radius, found.cross_talk)
            axes.plot(degrees, energy, color=colour, lw=1.8, label=f"{separation_mm:.0f} mm apart")
            axes.plot(degrees, found.gaussians[k](ANGLES_RAD), "--", color=colour, lw=1)
            axes.plot(degrees[::3], a * np.exp(-((degrees[::3] / c_deg) ** 2)), ".", color=colour, ms=4)
        axes.set_title(f"Plate at {TABLE_I[first][0]:.0f} mm")
        axes.grid(alpha=0.3)
        if number >= 2:
            axes.set_xlabel("angle of the plate / °")
        if number % 2 == 0:
            axes.set_ylabel("normalised energy")
        axes.legend(fontsize="small", loc="upper left")
    _style_key(figure.axes[1])
    figure.suptitle(f"Energy below the envelope, k R = {found.wavenumber_radius:.2f}, cross-talk {found.level:.3f}")
    return figure


def _style_key(axes: Axes) -> None:
    """What lines, dashes and dots are."""
    own = axes.get_legend()
    for style, name in (("-", "from physics"), ("--", "its Gaussian, equation 9"), (".", "the paper's Gaussian")):
        axes.plot([], [], style, color="0.3", label=name)
    handles, labels = axes.get_legend_handles_labels()
    axes.legend(handles[3:], labels[3:], fontsize="small", loc="upper right")
    if own is not None:
        axes.add_artist(own)


def _table(plain: TableFit, with_cross_talk: TableFit) -> Figure:
    """The widths c of Table I: the paper's, from one radius, and with cross-talk; residuals below."""
    figure = Figure(figsize=(10.5, 6.4), dpi=DPI, layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
    at = np.arange(len(TABLE_I))
    paper_deg = np.array([row[4] for row in TABLE_I])
    upper.plot(at, paper_deg, "k_", ms=22, mew=2, label="the paper")
    series = (
        (plain, "tab:orange", "o", f"k R = {plain.wavenumber_radius:.2f} alone: {plain.rms_c_deg:.2f}° RMS"),
        (with_cross_talk, "tab:blue", "s", f"with cross-talk: {with_cross_talk.rms_c_deg:.2f}° RMS"),
    )
    for side, (found, colour, marker, name) in zip((-0.14, 0.14), series, strict=True):
        upper.plot(at + side, paper_deg + found.residuals_c_deg, marker, color=colour, ms=6, label=name)
        lower.bar(at + side, found.residuals_c_deg, 0.26, color=colour)
    upper.set_ylabel("c / °")
    upper.set_title("Table I: width of the Gaussian of energy over the plate's angle")
    upper.legend(loc="upper right")
    upper.grid(axis="y", alpha=0.3)
    lower.axhline(0, color="k", lw=0.8)
    lower.grid(axis="y", alpha=0.3)
    lower.set_ylabel("ours less the paper's / °")
    lower.set_xticks(at, [f"{row[1]:.0f}" for row in TABLE_I])
    lower.set_xlabel("receivers apart / mm, plate at 200, 400, 600 and 800 mm")
    for axes in (upper, lower):
        for edge in (2.5, 5.5, 8.5):
            axes.axvline(edge, color="0.8", lw=0.8)
    for k in range(4):
        upper.text(3 * k + 1, 0.03, f"{TABLE_I[3 * k][0]:.0f} mm", ha="center", transform=upper.get_xaxis_transform())
    return figure
