"""IM-8 and IM-10: the cross-scan, and how its errors go."""

import math

import numpy as np
import pytest

from service.observations.scans.lines import cross_scan
from studies.star_image_report.scanning import (
    mean_of_scans,
    nyquist_spacing,
    truncated,
    variance_in_full,
    variance_of_long_scan,
    variance_sampled,
    with_background,
)


def steps(reach, spacing=1.0):
    return np.arange(-reach, reach + 1) * spacing


def gaussian(v, d=0.0):
    return np.exp(-0.5 * (v - d) ** 2)


@pytest.mark.parametrize(("spacing", "error"), [(1.0, 3e-8), (1.5, 1.3e-3), (2.0, 4.5e-2)])
def test_samples_are_as_good_as_the_integral_up_to_the_nyquist_step(spacing, error):
    """A Gaussian of sigma 1: the largest error over all displacements within a step."""
    worst = max(
        abs(cross_scan(gaussian(steps(20, spacing), d), spacing, 1e-9).displacement - d)
        for d in np.linspace(-spacing / 2, spacing / 2, 41)
    )
    assert worst == pytest.approx(error, rel=0.35)


def test_the_displacement_is_where_the_star_is():
    """Plus the first moment: the sign that 7.4 lost."""
    assert cross_scan(gaussian(steps(12), 0.7), 1.0, 1e-6).displacement == pytest.approx(0.7)


def test_the_step_for_the_report_s_optics():
    assert nyquist_spacing(632.8e-9, 0.35, 0.542 * 0.0254) == pytest.approx(8.04e-6, rel=1e-3)


@pytest.mark.parametrize(
    ("half", "found", "law"), [(6, 0.027, 0.033), (20, 0.0088, 0.0093), (60, 0.0030, 0.0031)]
)
def test_a_scan_cut_short_falls_short_as_predicted(half, found, law):
    """sinc² tails, d = .9: what is lost, and 2 V <Phi(V)> / E with the mean of the tails."""
    d, width = 0.9, 1.82
    lost = 1 - cross_scan(np.sinc((steps(half) - d) / width) ** 2, 1.0, 1e-9).displacement / d
    # The last sample stands for half a step beyond it; the mean of sin² is a half.
    end = half + 0.5
    mean = 0.5 * sum(0.5 * (width / np.pi / (end + side * d)) ** 2 for side in (-1, 1))
    predicted = 1 - truncated(d, end, mean, width) / d
    assert lost == pytest.approx(predicted, rel=0.05)
    assert predicted == pytest.approx(law, rel=0.1)
    assert lost == pytest.approx(found, rel=0.15)


def test_a_background_left_in_pulls_to_the_middle_as_predicted():
    samples = gaussian(steps(6), 1.0) + 0.02
    total = gaussian(steps(6), 1.0).sum()
    left_in = cross_scan(samples, 1.0, 1e-9).displacement
    assert left_in == pytest.approx(with_background(1.0, total, 13, 0.02), abs=1e-6)
    assert left_in == pytest.approx(0.906, abs=0.0005)
    assert cross_scan(samples, 1.0, 1e-9, background=0.02).displacement == pytest.approx(1.0, 1e-6)


SCANS = [
    # V, d, Monte Carlo of the report's reading, 7.36, 7.40, in full; sigma .02
    (6, 0.0, 0.1079, 0.1076, 0.0958, 0.1076),
    (6, 1.0, 0.1116, 0.1076, 0.0958, 0.1114),
    (6, 3.0, 0.1378, 0.1077, 0.0959, 0.1380),
    (12, 0.0, 0.2876, 0.2877, 0.2708, 0.2877),
    (24, 0.0, 0.7922, 0.7899, 0.7660, 0.7899),
]


@pytest.mark.parametrize(("reach", "d", "printed", "sampled", "long", "full"), SCANS)
def test_the_variance_law_holds_within_three_percent(reach, d, printed, sampled, long, full, rng):
    """All three laws at their figures, and 20,000 noisy scans against the full one."""
    light, sigma = gaussian(steps(reach), d), 0.02
    total = float(light.sum())
    assert math.sqrt(variance_sampled(1.0, sigma, reach, total)) == pytest.approx(sampled, abs=1e-4)
    ends = [math.erf((reach + side * d) / math.sqrt(2)) for side in (-1, 1)]
    integral = math.sqrt(math.pi / 2) * sum(ends)
    assert math.sqrt(variance_of_long_scan(1.0, sigma, reach, integral)) == pytest.approx(
        long, abs=1e-4
    )
    law = math.sqrt(variance_in_full(light, 1.0, sigma).variance)
    assert law == pytest.approx(full, abs=2e-4)
    noisy = light + rng.normal(0, sigma, (20_000, len(light)))
    scatter = (noisy @ steps(reach) / noisy.sum(axis=1)).std()
    assert scatter == pytest.approx(law, rel=0.03)
    assert scatter == pytest.approx(printed, rel=0.03)


def test_a_displaced_star_adds_its_own_term():
    light = gaussian(steps(6), 2.0)
    total = float(light.sum())
    plain = variance_sampled(1.0, 0.02, 6, total)
    added = 13 * 2.0**2 * 0.02**2 / total**2
    full = variance_in_full(light, 1.0, 0.02).variance
    assert full == pytest.approx(plain + added, rel=1e-3)


@pytest.mark.parametrize("scans", [1, 4, 16])
def test_m_scans_divide_the_variance_by_m(scans, rng):
    light = gaussian(steps(6))
    means = [mean_of_scans(light + rng.normal(0, 0.02, (scans, 13)), 1.0, 0.02) for _ in range(400)]
    predicted = {1: 0.1076, 4: 0.0538, 16: 0.0269}[scans]
    assert np.mean([m.sigma for m in means]) == pytest.approx(predicted, rel=0.01)
    assert np.std([m.displacement for m in means]) == pytest.approx(predicted, rel=5 / 28)


def test_too_little_light_has_no_variance_and_is_refused(rng):
    """Ratio 3.5, where 200 scans of sigma .2 scatter without bound."""
    light = gaussian(steps(6))
    ratio = light.sum() / (0.2 * math.sqrt(13))
    assert ratio == pytest.approx(3.5, abs=0.05)
    found = cross_scan(light, 1.0, 0.2)
    assert found.refused
    assert found.signal_ratio == pytest.approx(ratio)
    assert not cross_scan(light, 1.0, 0.1).refused
    noisy = light + rng.normal(0, 0.2, (20_000, 13))
    scatter = (noisy @ steps(6) / noisy.sum(axis=1)).std()
    assert scatter > 1.2 * math.sqrt(variance_sampled(1.0, 0.2, 6, float(light.sum())))


def test_long_scans_waste_what_is_known_of_the_shape():
    """The bound of a known Gaussian is .0213: five times below a scan of 6, 37 below 24."""
    slope = steps(24) * gaussian(steps(24))
    bound = 0.02 / math.sqrt(float(slope @ slope))
    # The bound over all displacements; at whole steps the sum is the integral.
    assert bound == pytest.approx(0.0213, abs=1e-4)
    assert 0.1076 / bound == pytest.approx(5.0, abs=0.1)
    assert 0.7899 / bound == pytest.approx(37.0, abs=0.5)


def test_photon_noise_adds_its_own_share(rng):
    """sum (v - d)² Phi / gain over (sum Phi)², by counted photons."""
    photons = 4000.0
    light = gaussian(steps(6), 0.4)
    counted = rng.poisson(photons * light, (20_000, 13)) / photons
    scatter = (counted @ steps(6) / counted.sum(axis=1)).std()
    assert cross_scan(light, 1.0, 1e-12, gain=photons).sigma == pytest.approx(scatter, rel=0.03)
