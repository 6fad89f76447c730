"""What is asked of the hybrid map, and which scene, rule and figure each key comes from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from comparison.hybrid_scans import PAPER
from comparison.hybrid_scores import Row
from echolume_processing.hybrid.rules.names import DEFAULT

Table = dict[str, dict[str, Row]]
"""Figures by scene and rule."""

TARGETS: Mapping[str, tuple[float, float | None]] = {
    "f1_1mm_demo": (0.97, 0.99),
    "f1_1mm_demo_nonedge": (0.985, 0.998),
    "f1_over_optical_min": (0.0, None),
    "f1_1mm_paper_array": (0.97, 0.99),
    "f1_0p5mm_matte": (0.995, None),
    "rmse_mm_demo": (1.5, 0.4),
    "glass_recall": (0.95, 0.99),
    "glass_precision": (0.97, 0.995),
    "glass_low_mm": (10, 2),
    "glass_low_precision": (0.97, 0.995),
    "glass_recall_beam30": (0.75, 0.9),
    "glass_precision_beam30": (0.75, 0.9),
    "glass_height_mm": (0.2, 0.05),
    "glass_height_disturbed_mm": (0.5, 0.1),
    "glass_small_mm": (40, 20),
    "black_f1_2mm": (0.95, 0.99),
    "false_transparent_pct": (0.1, 0.01),
    "tilted_unknown_pct": (95, 99),
    "hybrid_nees": (1.25, None),
    "hybrid_coverage95_pct": (92, 98),
    "fuse_s": (1, 0.3),
    "stripe_p99_ms": (50, None),
    "ping_p99_ms": (20, None),
    "grown_is_batch": (1, None),
    "step_optical_mm": (0.02, None),
    "step_ultrasonic_mm": (1.5, None),
    "flatness_mm": (0.35, None),
}
"""What is asked at least, and the aim. NEES is asked between 0.8 and 1.25, the coverage between 92 and 98."""

LOW = "glass-low"
LOW_MM = (10, 7, 4, 2)
"""How high the glass of that scene stands above what light sees."""
LOW_FOUND = 0.99
"""Recall from which it counts as found."""

FROM: Mapping[str, tuple[str, str, str]] = {
    "f1_1mm_demo": ("demo", DEFAULT, "f1_1mm"),
    "f1_1mm_demo_nonedge": ("demo", DEFAULT, "f1_1mm_nonedge"),
    "f1_1mm_paper_array": (PAPER, DEFAULT, "f1_1mm_nonedge"),
    "f1_0p5mm_matte": ("demo", DEFAULT, "f1_0p5mm_matte"),
    "f1_0p5mm_matte_nonedge": ("demo", DEFAULT, "f1_0p5mm_matte_nonedge"),
    "rmse_mm_demo": ("demo", DEFAULT, "rmse_mm"),
    "glass_recall": ("demo", DEFAULT, "glass_recall"),
    "glass_precision": ("demo", DEFAULT, "glass_precision"),
    "glass_low_precision": (LOW, DEFAULT, "glass_precision"),
    "glass_height_mm": ("demo", DEFAULT, "glass_height_mm"),
    "black_f1_2mm": ("demo", DEFAULT, "black_f1_2mm"),
    "false_transparent_pct": ("matte", DEFAULT, "transparent_pct"),
    "tilted_unknown_pct": ("glass-steep", DEFAULT, "glass_unknown_pct"),
    "hybrid_nees": ("demo", DEFAULT, "nees"),
    "hybrid_coverage95_pct": ("demo", DEFAULT, "coverage95_pct"),
    "synthesis_s": ("demo", DEFAULT, "seconds"),
    "step_optical_mm": ("demo", "optical", "step_light_mm"),
    "step_ultrasonic_mm": ("demo", "ultrasonic", "step_sound_mm"),
    "flatness_mm": ("demo", DEFAULT, "flatness_mm"),
}
"""Scene, rule and figure that each key comes from."""
DISTURBED = "set-up off by 0.5 mm, 0.2 deg and 3 K"
SMALL = "glass-small"
PLATES_MM = (50, 40, 30, 25, 20, 15)
"""Sides of the plates of that scene."""
FOUND = 0.9
"""Recall from which a plate counts as found."""


def headline(table: Table) -> Row:
    """The keys of the table of what is asked, as far as the scenes and rules were run."""
    taken = {
        key: table[scene][rule][name]
        for key, (scene, rule, name) in FROM.items()
        if name in table.get(scene, {}).get(rule, {}) and np.isfinite(table[scene][rule][name])
    }
    low = least_found(table, LOW, "low", LOW_MM, LOW_FOUND, "glass_low_mm")
    return taken | least_found(table, SMALL, "plate", PLATES_MM, FOUND, "glass_small_mm") | low | least_gain(table)


def least_found(table: Table, scene: str, region: str, sizes_mm: Sequence[int], recall: float, key: str) -> Row:
    """The least of some sizes of glass that is found and all larger ones too; infinite if the largest is not."""
    rows = table.get(scene, {}).get(DEFAULT)
    if rows is None:
        return {}
    least_mm = float("inf")
    for size_mm in sizes_mm:
        if not rows[f"{region}_{size_mm}_recall"] >= recall:
            break
        least_mm = float(size_mm)
    return {key: least_mm}


def gains(table: Table) -> Row:
    """F at 1 mm of the default rule less that of light alone, by scene."""
    both = {scene: rows for scene, rows in table.items() if {DEFAULT, "optical"} <= rows.keys()}
    return {scene: rows[DEFAULT]["f1_1mm"] - rows["optical"].get("f1_1mm", 0.0) for scene, rows in both.items()}


def least_gain(table: Table) -> Row:
    """The least of the gains, and all of them by scene."""
    found = gains(table)
    by_scene = {f"f1_over_optical/{scene}": gain for scene, gain in found.items()}
    return {"f1_over_optical_min": min(found.values()), **by_scene} if found else {}


def disturbed_rows(found: Mapping[str, Mapping[str, Row]]) -> Row:
    """Of set-ups that are off both ways, the worse height of the glass, of the default rule."""
    heights = [rows[DEFAULT]["glass_height_mm"] for name, rows in found.items() if name.startswith(DISTURBED)]
    return {"glass_height_disturbed_mm": float(np.max(heights))} if heights else {}


def beam_rows(found: Mapping[str, Mapping[str, Row]]) -> Row:
    """The worst of the altered beams, of the default rule."""
    beams = [rows[DEFAULT] for name, rows in found.items() if name.startswith("beam") and DEFAULT in rows]
    keys = ("glass_recall", "glass_precision")
    return {f"{key}_beam30": min(_or_zero(each.get(key)) for each in beams) for key in keys} if beams else {}


def _or_zero(value: float | None) -> float:
    """A precision of nothing found is no precision."""
    return 0.0 if value is None or np.isnan(value) else value


def flat(prefix: str, table: Mapping[str, Mapping[str, Row]]) -> Row:
    """Every figure of every scene and rule under one name; a figure that nothing supports is left out."""
    return {
        f"{prefix}/{scene}/{rule}/{name}": value
        for scene, rows in table.items()
        for rule, each in rows.items()
        for name, value in each.items()
        if np.isfinite(value)
    }


def show_asked(figures: Row) -> None:
    """Print what is asked beside what was measured."""
    print(f"\n{'hybrid map, rule ' + DEFAULT:28}{'measured':>10}{'at least':>10}{'aim':>8}")
    for key, (bar, aim) in TARGETS.items():
        measured = f"{figures[key]:10.4g}" if key in figures else f"{'-':>10}"
        print(f"{key:28}{measured}{bar:10g}" + (f"{aim:8g}" if aim is not None else f"{'-':>8}"))
    gain = {key: value for key, value in figures.items() if key.startswith("f1_over_optical/")}
    if gain:
        print(f"f1_over_optical_min is that of {min(gain, key=gain.__getitem__).partition('/')[2]}")


def show_scenes(table: Table, lacking: Mapping[str, Sequence[str]]) -> None:
    """Print of each scene what the map, light and sound are worth, and what the map does not say but must."""
    print(f"\n{'F at 1 mm':16}{'hybrid':>9}{'light':>9}{'sound':>9}  the map says what it must")
    for scene, rows in table.items():
        values = (rows.get(rule, {}).get("f1_1mm", float("nan")) for rule in (DEFAULT, "optical", "ultrasonic"))
        says = "; ".join(lacking.get(scene, ())) or "yes"
        print(f"{scene:16}" + "".join(f"{value:9.4f}" for value in values) + f"  {says if DEFAULT in rows else '-'}")
    small = table.get(SMALL, {}).get(DEFAULT)
    if small is not None:
        print(f"\n{SMALL:16}" + "".join(f"{plate_mm:>6} mm" for plate_mm in PLATES_MM))
        for name, form in (("recall", "9.3f"), ("mm", "9.3f")):
            print(f"{name:16}" + "".join(f"{small[f'plate_{plate_mm}_{name}']:{form}}" for plate_mm in PLATES_MM))
