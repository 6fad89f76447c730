"""Stripe peaks: known answers, the Cramer-Rao bound, saturation, clutter, and the emulated camera's true stripe."""

from __future__ import annotations

import numpy as np
import pytest

from echolume_drivers.emulated.optics import optical_truth
from echolume_drivers.emulated.scene import plate
from echolume_drivers.emulated.stripe_image import render_stripe, true_stripe
from echolume_processing.optical.blais_rioux import blais_rioux, blais_rioux_peaks
from echolume_processing.optical.stripe import FLANK_PX, extract

ROWS, COLUMNS = 400, 640


def gaussian_rows(
    columns: np.ndarray, sigma_px: float, amplitude: float = 140.0, noise: float = 0.0, seed: int = 1
) -> np.ndarray:
    """Frame with one stripe: a Gaussian around each row's column, over 30 DN of background."""
    x = np.arange(COLUMNS)
    clean = 30 + amplitude * np.exp(-((x - columns[:, None]) ** 2) / (2 * sigma_px**2))
    noisy = clean + np.random.default_rng(seed).normal(0, noise, clean.shape) if noise else clean
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def random_columns(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(60, COLUMNS - 60, ROWS)


def cramer_rao_px(sigma_px: float, amplitude: float, noise: float) -> float:
    return noise * np.sqrt(2 * sigma_px / np.sqrt(np.pi)) / amplitude


def test_the_fourth_order_operator_is_two_samples_left_minus_two_right() -> None:
    impulse = np.zeros((1, 9), dtype=np.uint8)
    impulse[0, 4] = 1
    assert blais_rioux(impulse, 4)[0].tolist() == [0, 0, -1, -1, 0, 1, 1, 0, 0]
    assert blais_rioux(impulse, 4).dtype == np.float64


def test_a_symmetric_peak_between_two_samples_is_found_at_the_half() -> None:
    row = np.array([[0, 0, 10, 60, 100, 100, 60, 10, 0, 0]], dtype=np.uint8)
    assert blais_rioux_peaks(row)[0] == pytest.approx(4.5, abs=1e-12)


def test_a_flat_row_has_no_blais_rioux_peak() -> None:
    assert np.isnan(blais_rioux_peaks(np.full((1, 20), 7, dtype=np.uint8))[0])


def test_orders_other_than_two_four_eight_are_refused() -> None:
    with pytest.raises(ValueError, match="order: expected 2, 4 or 8, got 3"):
        blais_rioux(np.zeros((2, 20), dtype=np.uint8), 3)


@pytest.mark.parametrize(("sigma_px", "limit"), [(1.2, 1.25), (2.0, 1.15), (3.0, 1.15), (4.5, 1.2)])
def test_columns_reach_the_cramer_rao_bound_at_every_width(sigma_px: float, limit: float) -> None:
    columns = random_columns()
    found = extract(gaussian_rows(columns, sigma_px, noise=5.0))
    error_px = found.column_px[:, 0] - columns
    assert np.isfinite(error_px).all()
    assert np.sqrt(np.mean(error_px**2)) < limit * cramer_rao_px(sigma_px, 140, 5.0)
    assert found.column_px.dtype == np.float64


def test_width_amplitude_noise_and_sigma_are_measured() -> None:
    columns = random_columns()
    found = extract(gaussian_rows(columns, 2.0, noise=5.0))
    assert np.median(found.width_px[:, 0]) == pytest.approx(2.0 * 2.3548, rel=0.1)
    assert np.median(found.amplitude_dn[:, 0]) == pytest.approx(140, rel=0.1)
    assert np.median(found.noise_dn) == pytest.approx(5.0, rel=0.1)
    assert np.median(found.sigma_px[:, 0]) == pytest.approx(cramer_rao_px(2.0, 140, 5.0), rel=0.2)


def test_noise_alone_gives_no_candidate() -> None:
    frame = np.clip(np.random.default_rng(3).normal(60, 8, (ROWS, COLUMNS)), 0, 255).astype(np.uint8)
    assert np.isfinite(extract(frame).column_px).sum() <= 1


def test_an_edge_between_dark_and_bright_is_no_stripe() -> None:
    frame = np.full((ROWS, COLUMNS), 20, dtype=np.uint8)
    frame[:, COLUMNS // 2 :] = 200
    assert not np.isfinite(extract(frame).column_px).any()


def test_a_saturated_stripe_keeps_its_centre_and_says_so() -> None:
    columns = random_columns()
    found = extract(gaussian_rows(columns, 3.0, amplitude=900.0, noise=3.0))
    error_px = found.column_px[:, 0] - columns
    assert np.sqrt(np.mean(error_px**2)) < 0.08
    assert found.saturated[:, 0].all()
    assert not extract(gaussian_rows(columns, 3.0)).saturated.any()


def test_a_weaker_second_stripe_is_the_second_candidate() -> None:
    columns = np.full(ROWS, 200.25)
    both = gaussian_rows(columns, 2.0).astype(np.int64) + gaussian_rows(columns + 90, 2.0, amplitude=60.0) - 30
    found = extract(both.astype(np.uint8), candidates=2)
    assert np.allclose(found.column_px[:, 0], 200.25, atol=0.05)
    assert np.allclose(found.column_px[:, 1], 290.25, atol=0.1)


def test_a_stripe_at_the_border_of_the_image_stays_inside() -> None:
    found = extract(gaussian_rows(np.full(ROWS, 1.0), 2.0))
    seen = found.column_px[np.isfinite(found.column_px)]
    assert ((seen >= 0) & (seen <= COLUMNS - 1)).all()


def test_frames_narrower_than_the_flanks_are_survived() -> None:
    assert extract(np.full((5, FLANK_PX), 90, dtype=np.uint8)).column_px.shape == (5, 3)


def test_a_frame_that_is_not_uint8_is_refused() -> None:
    with pytest.raises(ValueError, match="expected uint8 or uint16, got float64"):
        extract(np.zeros((4, 40)))  # pyright: ignore[reportArgumentType]


def test_the_emulated_stripe_is_found_within_the_speckle_where_it_truly_is() -> None:
    truth = optical_truth(1)
    frame = render_stripe(plate(), truth, "left", 10.0, np.random.default_rng(0), 4e-3, True)
    error_px = extract(frame).column_px[:, 0] - true_stripe(plate(), truth, "left", 10.0).rows(frame.shape[0])
    seen = np.isfinite(error_px)
    assert seen.sum() > 950
    assert abs(error_px[seen].mean()) < 0.01
    assert np.sqrt(np.mean(error_px[seen] ** 2)) < 0.15
