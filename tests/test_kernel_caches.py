"""The emulated rig's compiled kernels that are cached on disk rest on nothing outside their own file.

numba renews a cached kernel when its file changes, and not when another file does: a constant or a function that a
kernel takes from elsewhere would stay as it was when the kernel was first compiled, and change results silently.
(`processing` forgets its stale kernels by itself, see `echolume_processing.kernel_cache`.)
"""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
ROOM = ROOT / "drivers" / "echolume_drivers"


def files_with_kernels() -> list[Path]:
    return [path for path in sorted(ROOM.rglob("*.py")) if "cache=True" in path.read_text(encoding="utf-8")]


def imported_from_us(tree: ast.Module) -> set[str]:
    return {
        alias.asname or alias.name
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("echolume_")
        for alias in node.names
    }


def kernels(tree: ast.Module) -> list[ast.FunctionDef]:
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
    return [f for f in functions if any("njit" in ast.unparse(d) for d in f.decorator_list)]


def test_there_are_kernels() -> None:
    assert len(files_with_kernels()) >= 2


@pytest.mark.parametrize("path", files_with_kernels(), ids=lambda path: path.stem)
def test_a_cached_kernel_uses_nothing_from_other_files(path: Path) -> None:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    ours = imported_from_us(tree)
    for kernel in kernels(tree):
        used = {node.id for statement in kernel.body for node in ast.walk(statement) if isinstance(node, ast.Name)}
        assert not used & ours, f"{kernel.name} uses {sorted(used & ours)} from another file"
