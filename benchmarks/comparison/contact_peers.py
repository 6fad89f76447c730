"""Contact points the usual ways: numpy in batches, scipy ping by ping."""

from __future__ import annotations

import numpy as np
from scipy.optimize import least_squares


def images_of(rng: np.random.Generator, pings: int, distance_mm: float = 400.0) -> np.ndarray:
    """The emitter's images in planes tilted up to 17 degrees, (pings, 3)."""
    normals = np.column_stack([rng.uniform(-0.2, 0.2, (pings, 2)), np.ones(pings)])
    return 2 * distance_mm * normals / np.linalg.norm(normals, axis=1)[:, None]


def plane_paths(images: np.ndarray, receivers: np.ndarray) -> np.ndarray:
    """Paths over planes, (pings, receivers)."""
    return np.linalg.norm(images[:, None] - receivers, axis=2)


def batched_plane(receivers: np.ndarray, paths: np.ndarray) -> np.ndarray:
    """By numpy, the linear part of the plane alone: images (pings, 3)."""
    rows = np.column_stack([-2 * receivers[:, :2], np.ones(len(receivers))])
    u = (paths**2 - np.sum(receivers**2, axis=1)) @ np.linalg.pinv(rows).T
    return np.column_stack([u[:, :2], np.sqrt(u[:, 2] - np.sum(u[:, :2] ** 2, axis=1))])


def batched_point(receivers: np.ndarray, paths: np.ndarray) -> np.ndarray:
    """By numpy, points (pings, 3) of normal equations."""
    rows = np.empty((*paths.shape, 3))
    rows[..., :2], rows[..., 2] = 2 * receivers[:, :2], -2 * paths
    right = np.sum(receivers**2, axis=1) - paths**2
    u = np.linalg.solve(np.einsum("pri,prj->pij", rows, rows), np.einsum("pri,pr->pi", rows, right)[..., None])[..., 0]
    return np.column_stack([u[:, :2], np.sqrt(u[:, 2] ** 2 - np.sum(u[:, :2] ** 2, axis=1))])


def batched_whole(receivers: np.ndarray, paths: np.ndarray, sigma: float) -> tuple[np.ndarray, ...]:
    """By numpy, what a plane's ping gives: both fits and chi-squareds, contact points, and all covariances."""
    image, point = batched_plane(receivers, paths), batched_point(receivers, paths)
    ways = image[:, None] - receivers
    lengths = np.linalg.norm(ways, axis=2)
    plane_chi = np.sum((paths - lengths) ** 2, axis=1) / sigma**2
    predicted = np.linalg.norm(point, axis=1)[:, None] + np.linalg.norm(point[:, None] - receivers, axis=2)
    point_chi = np.sum((paths - predicted) ** 2, axis=1) / sigma**2
    j = ways / lengths[..., None] / sigma
    c = np.linalg.inv(np.einsum("pri,prj->pij", j, j))
    square = np.sum(image**2, axis=1)
    n = -image / np.sqrt(square)[:, None]
    across = np.eye(3) - n[:, :, None] * n[:, None]
    normal_c = across @ c @ across / square[:, None, None]
    d = 1 / (square[:, None] - image @ receivers.T)
    s = 0.5 * square[:, None] * d
    g = d[..., None] * ((1 - 2 * s)[..., None] * image[:, None] + s[..., None] * receivers)
    turn = (1 - s)[..., None, None] * np.eye(3) - ways[..., None] * g[..., None, :]
    contact_c = turn @ c[:, None] @ np.swapaxes(turn, -1, -2)
    return plane_chi < point_chi, image[:, None] - s[..., None] * ways, n, c / 4, normal_c, contact_c


def by_scipy(receivers: np.ndarray, paths: np.ndarray, start: np.ndarray) -> np.ndarray:
    """One ping's plane by scipy's least squares: the emitter's image (3,)."""
    return least_squares(lambda e: np.linalg.norm(e - receivers, axis=1) - paths, start).x


def refined(receivers: np.ndarray, paths: np.ndarray, sigma: np.ndarray, image: np.ndarray) -> np.ndarray:
    """Images after three Gauss-Newton steps."""
    for _ in range(3):
        ways = image[:, None] - receivers
        lengths = np.linalg.norm(ways, axis=2)
        j = ways / (lengths * sigma)[..., None]
        right = np.einsum("pri,pr->pi", j, (paths - lengths) / sigma)
        image = image + np.linalg.solve(np.einsum("pri,prj->pij", j, j), right[..., None])[..., 0]
    return image
