"""Claims of the systems IM-1 to IM-11 of the star image detection report, with their bounds."""

from benchmarks.bounds import Bound, every
from benchmarks.record import IMAGING
from benchmarks.report import Report
from benchmarks.sections import Section, Written, table
from studies.star_image_report.claims import Row
from studies.star_image_report.command import ROWS, run_imaging

_REPORT, _FRAMES = (
    "studies/star_image_report/test_further.py",
    "features/pictures/test_crossed_frames.py",
)
HELD_AGAINST = (
    ("rotation in the correlation", "a sum over a plane of its definition", _REPORT,
     "test_phi_of_a_field_is_the_integral_of_its_definition"),
    ("the search for k, h and theta", "the turns that fields were drawn with", _REPORT,
     "test_a_field_turned_by_any_angle_is_aligned"),
    ("a third wire, wires of several diameters", "waves from points all over the aperture",
     _REPORT, "test_the_tail_of_three_wires_is_that_of_points_all_over_the_aperture"),
    ("spectra with lines", "the sum of their lines", _REPORT,
     "test_a_spectrum_of_lines_is_the_sum_of_its_lines"),
    ("light on the detectors of a tail", "single rays of the disc, colours and orders, counted",
     _REPORT, "test_light_on_a_tail_s_detector_is_that_of_single_rays"),
    ("the acquisition aperture", "the share of the disc that falls on it; suns up to 10° off",
     _REPORT, "test_a_middle_detector_sees_the_share_of_the_disc_that_falls_on_it"),
    ("three photodiodes, acquisition of the sun", "suns from anywhere are found and centred",
     _REPORT, "test_a_sun_far_off_gives_no_signals_and_is_found"),
    ("the optimal order of measurements", "all choices, tried", _REPORT,
     "test_the_chosen_order_is_nearly_as_good_as_the_best_of_all_choices"),
    ("learned noise", "the residual variance of numpy's least squares", _REPORT,
     "test_learned_noise_is_that_of_least_squares"),
    ("crossed apertures as a camera's PSF", "the integral over the chords of the aperture",
     _FRAMES, "test_a_wire_spreads_light_across_itself"),
    ("stars on frames behind crossed wires",
     "drawn stars; see [frames](frames.md#frames-behind-crossed-wires)", _FRAMES,
     "test_places_scatter_as_they_say"),
)  # fmt: skip
"""Second ways to figures that the report only mentions, and the tests that use them."""


def _rows(quick: bool, seed: int) -> list[Row]:
    from os import devnull

    with open(devnull, "w", encoding="utf-8") as nowhere:
        return run_imaging(list(ROWS), seed, quick, out=nowhere)


def run(quick: bool, seed: int) -> Report:
    """Benchmark of the number of claims within their bounds by row."""
    measured = _rows(quick, seed)
    figures = {
        f"{row.name} {row.title}": f"{sum(c.holds for c in row.claims)} of {len(row.claims)}"
        for row in measured
    }
    return Report("imaging_claims", figures, bounds_of(measured))


def bounds_of(measured: list[Row]) -> list[Bound]:
    """Bounds of all rows: all claims of a row hold."""
    return [
        bound
        for row in measured
        for bound in every(
            f"{row.name}: claims within their bounds",
            [Bound(f"{row.name}: {c.says}", c.ours, "the claim", c.holds) for c in row.claims],
        )
    ]


def write(quick: bool, seed: int) -> Written:
    """Section of the verification: the claims that hold, counted by system."""
    measured = _rows(quick, seed)
    text = f"""
What the star image detection report claims, system by system; [imaging.md](imaging.md) has every
claim with what is measured, its verdict, and pictures.

What the report only names or leaves to others is held against a second way to the same number, each
in a test under `tests/`:

{table(("piece", "held against", "test"), _tests())}
"""
    return Written(text, bounds_of(measured))


def _tests() -> list[list[str]]:
    return [
        [piece, against, f"`{file}`: {test.removeprefix('test_').replace('_', ' ')}"]
        for piece, against, file, test in HELD_AGAINST
    ]


SECTION = Section("Star images", write, IMAGING)
