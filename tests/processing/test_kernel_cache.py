"""Cached kernels older than any source of their package are forgotten, newer ones stay."""

from __future__ import annotations

import os
from pathlib import Path

from echolume_processing.kernel_cache import forget_stale_kernels


def package(folder: Path, source_s: float, kernel_s: float) -> Path:
    (folder / "inner" / "__pycache__").mkdir(parents=True)
    source, kernel = folder / "other.py", folder / "inner" / "__pycache__" / "k.f-1.py311.nbi"
    for path, at_s in ((source, source_s), (kernel, kernel_s)):
        path.write_bytes(b"")
        os.utime(path, (at_s, at_s))
    return kernel


def test_a_kernel_older_than_a_source_is_forgotten(tmp_path: Path) -> None:
    kernel = package(tmp_path, source_s=2000.0, kernel_s=1000.0)
    assert forget_stale_kernels(tmp_path) == 1
    assert not kernel.exists()


def test_a_kernel_newer_than_every_source_stays(tmp_path: Path) -> None:
    kernel = package(tmp_path, source_s=1000.0, kernel_s=2000.0)
    assert forget_stale_kernels(tmp_path) == 0
    assert kernel.exists()


def test_an_empty_folder_has_none(tmp_path: Path) -> None:
    assert forget_stale_kernels(tmp_path) == 0
