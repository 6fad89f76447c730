"""Every number that a public function takes says its unit in its name, or is named here as having none."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
ROOMS = ("messages", "drivers", "daemon", "processing")
UNITS = ("mm", "s", "ms", "us", "ns", "hz", "rad", "deg", "px", "mps", "mm_per_s", "mm_per_s2", "c", "k", "dn", "mib")
NUMBERS = {"float", "float | None", "tuple[float, float]", "tuple[float, float, float]"}

DIMENSIONLESS = {
    "amount": "share of what a filter takes away",
    "contrast": "of speckle, 0 to 1",
    "dip": "share of a lobe's height",
    "f_number": "focal length over aperture",
    "max_chi_squared": "per degree of freedom",
    "origin": "sample of a template, may lie between two",
    "reach": "share of a board's square",
    "speed": "emulated motion: times real time",
    "surface": "share of a plate's amplitude",
    "threshold": "height of an envelope, in its own unit",
    "floor": "level of an envelope, in its own unit",
    "energy": "normalised to its largest",
    "wavenumber_radius": "k R",
    "whitening": "share of the largest spectral power",
    "low": "bounds of a setting whose name is in its command",
    "high": "bounds of a setting whose name is in its command",
}
OTHERWISE_SAID = {"wavenumber": "rad/mm, in the module's first lines", "position": "whatever an axis moves in"}

# Inner loops in the notation of their formulas; the functions around them take names with units.
KERNELS = (
    "kernels.py",
    "kirchhoff.py",
    "closed_form.py",
    "covariance.py",
    "stripe_kernel.py",
    "stripe_measure.py",
    "scipy_typed.py",
)


def functions(body: list[ast.stmt]) -> Iterator[ast.FunctionDef]:
    for node in body:
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            yield from functions(node.body)
        elif isinstance(node, ast.FunctionDef) and (node.name == "__init__" or not node.name.startswith("_")):
            yield node


def numbers(room: str) -> Iterator[tuple[str, str]]:
    """Where, and name, of every parameter of a public function that is a number or a few of them."""
    for path in sorted((ROOT / room).rglob("*.py")):
        for function in functions(ast.parse(path.read_text(encoding="utf-8")).body):
            where = f"{path.relative_to(ROOT)}:{function.name}"
            if not any(kernel in where for kernel in KERNELS):
                for given in (*function.args.posonlyargs, *function.args.args, *function.args.kwonlyargs):
                    if given.annotation is not None and ast.unparse(given.annotation) in NUMBERS:
                        yield where, given.arg


@pytest.mark.parametrize("room", ROOMS)
def test_numbers_have_their_unit_in_their_name(room: str) -> None:
    found = list(numbers(room))
    bare = [(where, name) for where, name in found if not name.endswith(tuple(f"_{unit}" for unit in UNITS))]
    assert found
    assert [at for at in bare if at[1] not in DIMENSIONLESS | OTHERWISE_SAID] == []


def test_no_exception_is_kept_that_nobody_needs() -> None:
    used = {name for room in ROOMS for _, name in numbers(room)}
    assert set(DIMENSIONLESS | OTHERWISE_SAID) - used == set()
