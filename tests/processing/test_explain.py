"""What one cell is, in plain words: everything that the map holds of it, and refusals that say why."""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from echolume_messages.errors import ConfigError
from echolume_messages.types import Label
from echolume_processing.commands import explain as command
from echolume_processing.explain import explain, notes_at, text
from echolume_processing.export import formats
from echolume_processing.hybrid.stored import StoredMap
from echolume_processing.hybrid.witnesses import Witnesses
from processing.some_map import FIELD, some_map

GLASS = (-10.0, -2.0)


def run(*words: str) -> int:
    """The command as the front door calls it."""
    parser = argparse.ArgumentParser(description=command.__doc__)
    command.configure(parser)
    return command.run(parser.parse_args(words))


def made(folder: Path, name: str = "map.npz") -> str:
    formats.format_of(folder / name).write(some_map(), folder / name)
    return str(folder / name)


def at(kept: StoredMap, x_mm: float, y_mm: float) -> int:
    """Flat index of the cell of a place."""
    return int((y_mm - FIELD.y_mm[0]) / FIELD.cell_mm) * FIELD.shape[1] + int((x_mm - FIELD.x_mm[0]) / FIELD.cell_mm)


def test_everything_that_the_map_holds_of_a_cell_is_told() -> None:
    kept = some_map()
    k = at(kept, *GLASS)
    cell, said = kept.found.cells[k], explain(kept, *GLASS)
    assert (said["ix"], said["iy"]) == (cell["ix"], cell["iy"])
    assert (said["x_mm"], said["y_mm"]) == (-9.75, -1.75)
    assert said["label"] == "transparent"
    for name in ("front_mm", "behind_mm", "sigma_mm", "probability"):
        assert said[name] == float(cell[name])
    assert said["stripes"] == kept.found.stripes.of(k).tolist() != []
    assert said["pings"] == kept.found.pings.of(k).tolist() != []
    assert said["nearest_ping"] == cell["ping"]
    assert (said["optical_points"], said["height_pings"]) == (cell["optical_n"], cell["ultrasonic_n"])


@pytest.mark.parametrize("name", ["map.npz", "map.ply", "map.las", "map.e57", "map.mesh.ply"])
def test_the_command_tells_the_same_from_every_format(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(made(tmp_path, name), "-10", "-2.0", "--json") == 0
    assert json.loads(capsys.readouterr().out) == explain(some_map(), *GLASS)


def test_the_command_tells_it_in_words(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(made(tmp_path), "-10", "-2.0") == 0
    told, said = capsys.readouterr().out, explain(some_map(), *GLASS)
    assert "transparent: sound comes back from it, light goes through; right with a probability of" in told
    assert f"{100 * (said['probability'] or 0):.2f} %" in told
    assert f"{said['front_mm']:.3f} mm +- {said['sigma_mm']:.3f} mm" in told
    assert "behind it light sees" in told
    assert all(str(trigger) in told for trigger in (*(said["stripes"] or []), *(said["pings"] or [])))
    assert "two heights, 4.3 mm apart" in told


def test_of_an_unknown_cell_nothing_is_claimed() -> None:
    told = text(explain(some_map(), 6.0, 14.0))
    assert "unknown: nothing is claimed here" in told
    assert "probability" not in told
    assert "Height   none" in told


def test_of_an_unknown_cell_with_a_height_the_height_is_claimed() -> None:
    kept = some_map()
    cells = kept.found.cells
    k = at(kept, 6.0, 14.0)
    cells["front_mm"][k], cells["sigma_mm"][k], cells["ultrasonic_n"][k] = 2.5, 0.25, 1
    told = text(explain(kept, 6.0, 14.0))
    assert "unknown: its height is known, what it is is not" in told
    assert "2.500 mm +- 0.250 mm" in told
    assert "the height rests on 1 ping\n" in told


def test_a_map_without_tables_and_probabilities_says_so() -> None:
    kept = some_map()
    kept.found.cells["probability"][kept.found.cells["label"] != Label.UNKNOWN] = np.nan
    bare = replace(kept, found=replace(kept.found, stripes=Witnesses(), pings=Witnesses()))
    told, said = text(explain(bare, *GLASS)), explain(bare, *GLASS)
    assert (said["probability"], said["stripes"], said["pings"]) == (None, None, None)
    assert "the map states no probability" in told
    assert "the map does not say which stripes" in told


def test_notes_about_other_places_are_left_out() -> None:
    notes = ("light and sound disagree in 9 cells around x -12, y 5 mm: unknown", "narrow band around 40 kHz")
    found = replace(some_map().found, notes=notes)
    assert notes_at(found, 0.0, 0.0) == list(notes)
    assert notes_at(found, 80.0, 0.0) == [notes[1]]


@pytest.mark.parametrize("place", [(20.0, 0.0), (-20.01, 0.0), (0.0, 19.5), (0.0, -10.6), (np.nan, 0.0)])
def test_a_place_outside_is_refused_with_the_field(place: tuple[float, float]) -> None:
    with pytest.raises(ConfigError, match=r"outside the map: expected x from -20 to 20 and y from -10\.5 to 19\.5 mm"):
        explain(some_map(), *place)


def test_a_file_that_is_no_map_is_refused(tmp_path: Path) -> None:
    (tmp_path / "map.npz").write_bytes(b"no map")
    with pytest.raises(ConfigError, match="cannot be read") as refused:
        run(str(tmp_path / "map.npz"), "0", "0")
    assert refused.value.exit_code == 2
    with pytest.raises(FileNotFoundError):
        run(str(tmp_path / "none.npz"), "0", "0")
