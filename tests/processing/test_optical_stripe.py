"""Stripe peaks: known answers, the Cramer-Rao bound, saturation, clutter, and the emulated camera's true stripe."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from echolume_drivers.emulated.optics import optical_truth
from echolume_drivers.emulated.scene import plate
from echolume_drivers.emulated.stripe_image import render_stripe, true_stripe
from echolume_processing.optical.blais_rioux import blais_rioux, blais_rioux_peaks
from echolume_processing.optical.stripe import FLANK_PX, extract, speckle_sigma_px
from echolume_processing.optical.trace import trace

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


@pytest.mark.parametrize(("sigma_px", "limit"), [(1.2, 1.1), (2.0, 1.1), (3.0, 1.1), (4.5, 1.1)])
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


@pytest.mark.parametrize("crest", [300.0, 450.0, 900.0])
def test_a_clipped_stripe_is_as_exact_as_its_flanks_allow(crest: float) -> None:
    columns = random_columns()
    found = extract(gaussian_rows(columns, 1.8, amplitude=crest, noise=2.0), 1)
    error_px = found.column_px[:, 0] - columns
    assert np.sqrt(np.mean(error_px**2)) < 0.015
    assert np.median(found.sigma_px[:, 0]) == pytest.approx(np.std(error_px), rel=0.35)


@settings(max_examples=25, deadline=None)
@given(st.floats(-0.5, 0.5), st.floats(0.9, 5.0), st.floats(60, 210))
def test_a_shift_of_a_part_of_a_pixel_is_recovered(shift_px: float, sigma_px: float, crest: float) -> None:
    columns = np.linspace(300, 301, 9)
    still, moved = (
        extract(gaussian_rows(c, sigma_px, crest)[: len(columns)], 1) for c in (columns, columns + shift_px)
    )
    rounding_px = cramer_rao_px(sigma_px, crest, 0.41)  # of both frames to whole digital numbers
    assert np.allclose(moved.column_px - still.column_px, shift_px, atol=0.005 + 5 * rounding_px)


@pytest.mark.parametrize("sigma_px", [1.2, 2.5])
def test_twelve_bits_are_finer_than_eight(sigma_px: float) -> None:
    columns = random_columns()
    x = np.arange(COLUMNS)
    clean = 480 + 2200 * np.exp(-((x - columns[:, None]) ** 2) / (2 * sigma_px**2))
    frame = np.rint(clean + np.random.default_rng(0).normal(0, 8, clean.shape)).astype(np.uint16)
    found = extract(frame, 2)
    rms_px = np.sqrt(np.mean((found.column_px[:, 0] - columns) ** 2))
    assert rms_px < 1.15 * cramer_rao_px(sigma_px, 2200, 8)
    assert np.median(found.amplitude_dn[:, 0]) == pytest.approx(2200, rel=0.1)
    assert not found.saturated.any()
    assert np.isnan(found.column_px[:, 1]).all()


def test_twelve_bits_clip_at_4095_and_other_depths_where_they_end() -> None:
    x = np.arange(COLUMNS)
    bright = 400 + 9000 * np.exp(-((x - 200.3) ** 2) / 18)
    frame = np.tile(np.minimum(bright, 4095), (5, 1)).astype(np.uint16)
    assert extract(frame).saturated[:, 0].all()
    assert extract(frame).column_px[0, 0] == pytest.approx(200.3, abs=0.01)
    assert not extract(frame, bits=14).saturated.any()


@pytest.mark.parametrize("shape", [(ROWS, COLUMNS), (37, 301)])
def test_columns_of_a_frame_are_the_rows_of_its_transpose(shape: tuple[int, int]) -> None:
    frame = gaussian_rows(random_columns(), 2.0, noise=5.0)[: shape[0], : shape[1]]
    by_rows, by_columns = extract(frame), extract(np.ascontiguousarray(frame.T), axis=0)
    for name in ("column_px", "width_px", "amplitude_dn", "saturated", "noise_dn", "sigma_px"):
        assert np.array_equal(getattr(by_rows, name), getattr(by_columns, name), equal_nan=name != "saturated")


def test_how_the_frame_lies_in_memory_makes_no_difference() -> None:
    frame = gaussian_rows(random_columns(), 2.0, noise=5.0)
    expected = extract(frame).column_px
    locked = frame.copy()
    locked.flags.writeable = False
    bytes_in = b"x" + frame.tobytes()
    odd = np.frombuffer(bytes_in, dtype=np.uint8, offset=1).reshape(frame.shape)
    for same in (locked, odd, np.dstack([frame, frame])[:, :, 0], np.asfortranarray(frame)):
        assert np.array_equal(extract(same).column_px, expected, equal_nan=True)
    assert locked.flags.writeable is False
    assert frame.flags.writeable


@pytest.mark.parametrize("width", [1, 2, 15, 63, 127, 129, 255, 257, 640])
def test_every_width_of_frame_is_searched_to_its_end(width: int) -> None:
    frame = np.full((3, width), 20, dtype=np.uint8)
    centre = max(width - 20, width // 2)
    x = np.arange(width)
    frame += np.rint(150 * np.exp(-((x - centre) ** 2) / 8)).astype(np.uint8)
    found = extract(frame, 1)
    if width > FLANK_PX:
        assert np.allclose(found.column_px, centre, atol=0.1)


def test_a_lone_hot_pixel_brighter_than_the_stripe_is_passed_over() -> None:
    columns = random_columns()
    frame = gaussian_rows(columns, 1.5, amplitude=45.0, noise=2.0)
    frame[np.arange(ROWS), (columns.astype(int) + 150) % COLUMNS] = 255
    found = extract(frame, 1)
    assert np.mean(np.abs(found.column_px[:, 0] - columns) < 0.5) > 0.99
    assert not found.saturated.any()


def test_a_stripe_in_the_dark_beside_a_bright_area_is_found() -> None:
    frame = gaussian_rows(np.full(ROWS, 150.25), 1.8, amplitude=40.0, noise=2.0)
    frame[:, 300:] += 150
    found = extract(frame, 2)
    near = np.abs(found.column_px - 150.25) < 0.5
    assert near.any(axis=1).mean() > 0.99


def test_clutter_hides_few_rows_from_the_line_through_the_candidates() -> None:
    rng = np.random.default_rng(5)
    columns = 250 + 0.2 * np.arange(ROWS)
    frame = gaussian_rows(columns, 1.8, noise=5.0).astype(np.float64)
    y, x = np.mgrid[:ROWS, :COLUMNS]
    for _ in range(8):
        v, u, size = rng.uniform(0, ROWS), rng.uniform(0, COLUMNS), rng.uniform(2, 7)
        frame += rng.uniform(60, 220) * np.exp(-((x - u) ** 2 + (y - v) ** 2) / (2 * size**2))
    frame += 80 * np.exp(-((x - 480 + 0.3 * y) ** 2) / 6)
    frame.ravel()[rng.integers(0, frame.size, 80)] = 255
    dirty = np.clip(np.rint(frame), 0, 255).astype(np.uint8)
    found = extract(dirty, 4)
    line = found.column_px[np.arange(ROWS), trace(found)]
    usual = np.mean(np.abs(np.argmax(dirty, axis=1) - columns) > 2)
    assert usual > 0.1
    assert np.mean(~(np.abs(line - columns) <= 2)) < 0.1 * usual


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_frames_of_anything_give_finite_candidates_inside_the_frame_or_none(dtype: type) -> None:
    rng = np.random.default_rng(9)
    full = 255 if dtype is np.uint8 else 4095
    for scale in (1, 4, 16, 60):
        coarse = rng.integers(0, full + 1, (40, 200 // scale + 2))
        found = extract(np.repeat(coarse, scale, axis=1)[:, :201].astype(dtype), 4)
        seen = np.isfinite(found.column_px)
        assert ((found.column_px[seen] >= 0) & (found.column_px[seen] <= 200)).all()
        for values in (found.width_px, found.amplitude_dn, found.sigma_px):
            assert (np.isfinite(values) == seen).all()
            assert (values[seen] > 0).all()


def test_speckle_is_part_of_each_sigma() -> None:
    frame = gaussian_rows(random_columns(), 2.0, noise=5.0)
    plain, grainy = extract(frame, 1), extract(frame, 1, speckle_px=0.1)
    assert np.allclose(grainy.sigma_px, np.hypot(plain.sigma_px, 0.1))
    # 650 nm at f/8 on 3.45 um pixels: 0.65 * 16 / (2 pi) = 1.655 um.
    assert speckle_sigma_px(650e-6, 8.0, 3.45e-3) == pytest.approx(1.655 / 3.45, rel=1e-3)
    assert speckle_sigma_px(650e-6, 8.0, 3.45e-3, contrast=0.2) == pytest.approx(0.2 * 1.655 / 3.45, rel=1e-3)


def test_senseless_arguments_are_refused() -> None:
    frame = np.zeros((4, 40), dtype=np.uint8)
    with pytest.raises(ValueError, match="candidates: expected at least 1, got 0"):
        extract(frame, 0)
    with pytest.raises(ValueError, match="axis: expected 0 or 1, got 2"):
        extract(frame, axis=2)  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="bits: expected 1 to 8 for uint8, got 12"):
        extract(frame, bits=12)


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
