"""Claims of IM-4: diffraction crosses of wire meshes."""

from typing import Any

import numpy as np

from service.features.pictures.centroids.optics import Pupil, centres, image_at, thermal
from service.features.pictures.centroids.window import Array
from studies.star_image_report import wires_and_lines
from studies.star_image_report.claims import Claim, Picture, Row, Study
from studies.star_image_report.optics import DIAMETER_M, LASER_M
from studies.star_image_report.transfer import between_wires, image_by_fft
from studies.star_image_report.wires import (
    INCH_M,
    Mesh,
    Wires,
    along_p,
    filtered,
    first_tail_null_rad,
    mesh_intensity,
    order_angle_rad,
    shares_of_light,
    tail,
)

MESH = Mesh(INCH_M / 18.0, 0.011 * INCH_M)
WIRES_INCH = (0.00443, 0.00663, 0.007, 0.011)
THIN_M, THICK_M = 0.00443 * INCH_M, 0.00663 * INCH_M
COUNTS = (0, 1, 2, 4, 6, 8, 10)
SEPARATIONS_INCH = (0.05, 0.125, 0.271, 0.4)
FRINGE_RAD = 2.0 * LASER_M / DIAMETER_M
HALF_ORDER_RAD = 0.5 * LASER_M / MESH.pitch_m


def mesh(study: Study) -> Row:
    """Check the claims of IM-4 on wire meshes."""
    fine = 1200 if study.quick else 1500
    across = MESH.across(DIAMETER_M)
    screen = filtered(DIAMETER_M, across, across, fine)
    orders = np.arange(1, 17)
    at = np.array([order_angle_rad(int(m), LASER_M, MESH) for m in orders])
    light = along_p(screen, LASER_M, at)
    formula = mesh_intensity(at, 0.0, LASER_M, MESH, 9)
    formula = formula / float(mesh_intensity(0.0, 0.0, LASER_M, MESH, 9))
    nulls = {inch: _null(inch * INCH_M, fine) for inch in WIRES_INCH}
    counted = {n: _shares(MESH.wires(n), MESH.wires(n)) for n in COUNTS}
    depths = {s: _depth(_pair(s), fine) for s in SEPARATIONS_INCH}
    lone = max(_depth([(0.0, wire)], fine) for wire in (THIN_M, THICK_M))
    return Row(
        "IM-4",
        "Wire-mesh filters",
        (
            *_orders(light, formula),
            _nulls(nulls),
            *_trade_off(counted),
            *_apodisation(depths, lone, fine),
            *_observations(screen),
            *wires_and_lines.claims(study),
        ),
        _pictures(screen, counted, fine) | wires_and_lines.pictures(),
    )


def _orders(light: Array, formula: Array) -> tuple[Claim, ...]:
    gone, dash = light[[4, 9, 14]], light[:4]
    off = float(np.abs(dash / formula[:4] - 1.0).max())
    constant = [_constant(wavelength) for wavelength in (LASER_M, LASER_M / 2.0)]
    return (
        Claim(
            "4.3",
            "orders 5, 10 and 15 are cancelled by nulls of the opening",
            f"at most {gone.max():.1e} of the centre; order 4 has {light[3]:.1e}, 6 {light[5]:.1e}",
            "confirmed",
            bool(np.all(gone < 2e-5) and light[3] > 3e-3 and light[5] > 1e-3),
            {f"order {m}": float(light[m - 1]) for m in (4, 5, 6, 10, 15)},
        ),
        Claim(
            "4.1",
            "a dash is four principal maxima, lambda / d apart",
            "orders 1 to 4: "
            + ", ".join(f"{x:.4f}" for x in dash)
            + f"; equation 4.1 to {off:.0%}, the aperture being round",
            "confirmed",
            off < 0.09,
            {f"order {m}": float(dash[m - 1]) for m in range(1, 5)},
        ),
        Claim(
            "4.1",
            "C grows with s⁴, the aperture's diameter, and 1/lambda",
            "s⁴/(lambda f)², N⁴ standing in the other factors: the middle of a square of openings "
            f"over that is {constant[0]:.4f}, and {constant[1]:.4f} at half the wavelength",
            "corrected",
            bool(np.abs(np.array(constant) - 1.0).max() < 1e-6),
            {"632.8 nm": constant[0], "316.4 nm": constant[1]},
        ),
    )


def _constant(wavelength_m: float, openings: int = 5) -> float:
    cell = MESH.pitch_m / 40
    open_share = between_wires(centres(40 * openings, cell), cell, MESH.wires(openings + 1))
    square = Pupil(open_share[:, None] * open_share[None, :], cell)
    middle = np.zeros(1)
    middle_intensity = float(image_at(square, wavelength_m, middle, middle)[0, 0])
    return middle_intensity / float(mesh_intensity(0.0, 0.0, wavelength_m, MESH, openings))


def _null(wire_m: float, fine: int) -> float:
    expected = LASER_M / wire_m
    one = filtered(DIAMETER_M, [(0.0, wire_m)], [], fine)
    return first_tail_null_rad(one, LASER_M, DIAMETER_M, 0.7 * expected, 1.3 * expected)


def _nulls(nulls: dict[float, float]) -> Claim:
    off = {inch: null * inch * INCH_M / LASER_M - 1.0 for inch, null in nulls.items()}
    return Claim(
        "4.3",
        "the distance of a null goes as one over the wire's diameter",
        "; ".join(f"{inch} in: {1e3 * null:.2f} mrad" for inch, null in nulls.items())
        + f"; lambda / wire within {max(map(abs, off.values())):.1%}",
        "confirmed",
        max(map(abs, off.values())) < 0.02,
        {f"null of {inch} in (mrad)": 1e3 * null for inch, null in nulls.items()},
    )


def _shares(across_x: Wires, across_y: Wires) -> tuple[float, float, float]:
    pupil = filtered(DIAMETER_M, across_x, across_y, cells=600, width=2.0)
    return shares_of_light(pupil, LASER_M, HALF_ORDER_RAD)


def _trade_off(counted: dict[int, tuple[float, float, float]]) -> tuple[Claim, ...]:
    tails, beside = ([shares[k] for shares in counted.values()] for k in (1, 2))
    few, many = counted[1], counted[8]
    law, full = MESH.shares(), counted[10]
    uneven, even = _shares(MESH.wires(8), MESH.wires(2)), _shares(MESH.wires(5), MESH.wires(5))
    return (
        Claim(
            "4.3",
            "more wires bring more light into the tails, and more beside them",
            f"1 wire each way: {few[1]:.3f} on tails, {few[2]:.3f} beside; "
            f"8: {many[1]:.3f}, {many[2]:.3f}; all: {full[1]:.3f}, {full[2]:.3f}",
            "confirmed",
            bool(np.all(np.diff(tails) > 0.0) and np.all(np.diff(beside) > 0.0)),
            {f"{n} wires": shares for n, shares in counted.items()},
        ),
        Claim(
            "4.4, 5.5",
            "spreading depends on the total number of wires, not on its split",
            "on the product of what the axes block, e²: of ten wires, eight and two spread "
            f"{uneven[2]:.4f}, five and five {even[2]:.4f}; the law gives a full mesh "
            f"{law[0]:.3f}, {law[1]:.3f}, {law[2]:.3f}",
            "qualified",
            uneven[2] < even[2] and max(abs(f - x) for f, x in zip(full, law, strict=True)) < 0.02,
            {"8 and 2": uneven[2], "5 and 5": even[2], "law": law},
        ),
    )


def _pair(separation_inch: float) -> Wires:
    half = separation_inch * INCH_M / 2.0
    return [(-half, THIN_M), (half, THICK_M)]


def _depth(wires: Wires, fine: int) -> float:
    p = np.linspace(0.8 * LASER_M / THICK_M, 1.8 * LASER_M / THIN_M, 200)
    light = tail(filtered(DIAMETER_M, wires, [], fine), LASER_M, p, FRINGE_RAD)
    return float(light.min() / light.mean())


def _apodisation(depths: dict[float, float], lone: float, fine: int) -> tuple[Claim, ...]:
    pair = filtered(DIAMETER_M, _pair(0.271), [], fine)
    places = np.array([1.5, 2.0]) * LASER_M / THIN_M
    lobe, common = tail(pair, LASER_M, places, FRINGE_RAD).tolist()
    return (
        Claim(
            "4.3",
            "two wires with diameters as 1 to 1.5 fill each other's nulls",
            f"the darkest place of the tail over its mean: {depths[0.271]:.2f}, of one wire "
            f"{lone:.3f}; the null both share, at 2 lambda / thin, stays ({common / lobe:.3f} of "
            "its neighbour)",
            "confirmed",
            depths[0.271] > 0.16 and lone < 0.02 and common < 0.02 * lobe,
            {"pair": depths[0.271], "one wire": lone, "common null": common / lobe},
        ),
        Claim(
            "4.3",
            "best where the wires are a radius of the aperture apart",
            ", ".join(f"{s} in: {d:.2f}" for s, d in depths.items())
            + ": any separation does whose fringes are finer than the lobes",
            "qualified",
            depths[0.05] < 0.5 * depths[0.125] and min(depths[0.271], depths[0.4]) > 0.16,
            {f"{s} in": d for s, d in depths.items()},
        ),
    )


def _observations(screen: Pupil) -> tuple[Claim, ...]:
    colours = thermal(5800.0, 500e-9, 700e-9, 81)
    p = np.linspace(6.6, 7.6, 61) * LASER_M / MESH.pitch_m
    single = along_p(screen, LASER_M, p)
    wide = sum(
        float(share) * along_p(screen, float(w), p)
        for w, share in zip(colours.wavelength_m, colours.power, strict=True)
    )
    dots = [float(np.ptp(x) / (x.max() + x.min())) for x in (single, np.asarray(wide))]
    across = MESH.wires(9)
    side = DIAMETER_M / np.sqrt(2.0)
    round_one = filtered(DIAMETER_M, across, across, 600, 2.0)
    place = round_one.places_m
    inside = (np.abs(place) <= side / 2.0).astype(float)
    square = Pupil(round_one.transmission * inside[:, None] * inside[None, :], round_one.cell_m)
    spread = [_corner_light(pupil) for pupil in (round_one, square)]
    return (
        Claim(
            "4.3",
            "in broad light the dashes stay and the dots are hardly seen",
            f"contrast of the orders in a dash: {dots[0]:.2f} in laser light, {dots[1]:.2f} from "
            "500 to 700 nm",
            "confirmed",
            dots[1] < 0.6 * dots[0],
            {"laser": dots[0], "500 to 700 nm": dots[1]},
        ),
        Claim(
            "4.3",
            "a mask that is not round spreads somewhat less",
            f"light off the axes: {spread[0]:.4f} behind a circle, {spread[1]:.4f} behind the "
            "square within it",
            "confirmed",
            spread[1] < spread[0],
            {"circle": spread[0], "square": spread[1]},
        ),
    )


def _corner_light(pupil: Pupil) -> float:
    return shares_of_light(pupil, LASER_M, HALF_ORDER_RAD)[2]


def _pictures(
    screen: Pupil, counted: dict[int, tuple[float, float, float]], fine: int
) -> dict[str, Picture]:
    return {
        "imaging-cross": Picture(
            "The cross of the 18-mesh screen. Circles: equation 4.1; dotted: its missing orders.",
            (9.0, 3.6),
            lambda figure: _draw_cross(figure, screen),
        ),
        "imaging-apodisation": Picture(
            "Tails of one wire have nulls; two diameters fill each other's, but for the one both "
            "share at 11.2 mrad.",
            (5.6, 3.2),
            lambda figure: _draw_apodised(figure, fine),
        ),
        "imaging-wires": Picture(
            "More wires: more light on the tails, and beside them. With two each way nothing "
            "stands beside.",
            (8.0, 3.4),
            lambda figure: _draw_wire_counts(figure, counted),
        ),
    }


def _draw_cross(figure: Any, screen: Pupil) -> None:
    axes = figure.subplots(1, 2, width_ratios=(1, 1.5))
    edge = 11.0 * LASER_M / MESH.pitch_m
    angle = np.linspace(-edge, edge, 701)
    image = image_at(screen, LASER_M, angle, angle)
    shown = np.log10(image / image.max() + 1e-12)
    axes[0].imshow(
        shown,
        extent=[-11, 11, -11, 11],
        vmin=-6,
        vmax=0,
        cmap="inferno",
        origin="lower",
        interpolation="nearest",
    )
    axes[0].set(xlabel="p (λ/d)", ylabel="q (λ/d)", title="18-mesh screen, log")
    axes[0].grid(visible=False)
    p = np.linspace(0.0, 16.5, 3301)
    light = along_p(screen, LASER_M, p * LASER_M / MESH.pitch_m)
    axes[1].semilogy(p, light, lw=0.7, color="#0b5394")
    orders = np.arange(0, 17)
    at = orders * LASER_M / MESH.pitch_m
    formula = mesh_intensity(at, 0.0, LASER_M, MESH, 9)
    axes[1].plot(orders, formula / formula[0], "o", mfc="none", ms=4, color="#b45309")
    for null in (5, 10, 15):
        axes[1].axvline(null, color="0.6", lw=0.8, ls=":")
    axes[1].set(xlabel="p (λ/d)", title="along a tail", ylim=(1e-8, 2))


def _draw_apodised(figure: Any, fine: int) -> None:
    axis = figure.subplots()
    p = np.linspace(1e-3, 14e-3, 700)
    for label, wires, color in (
        (".00443 in", [(0.0, THIN_M)], "#0b5394"),
        (".00663 in", [(0.0, THICK_M)], "#b45309"),
        ("both, .271 in apart", _pair(0.271), "black"),
    ):
        light = tail(filtered(DIAMETER_M, wires, [], fine), LASER_M, p, FRINGE_RAD)
        width = 1.4 if color == "black" else 0.9
        axis.semilogy(1e3 * p, light, label=label, color=color, lw=width)
    axis.set(xlabel="p (mrad)", ylabel="tail over centre", ylim=(1e-9, 1e-2))
    axis.legend(fontsize=7)


def _draw_wire_counts(figure: Any, counted: dict[int, tuple[float, float, float]]) -> None:
    axes = figure.subplots(1, 2)
    n = np.array(list(counted))
    shares = np.array(list(counted.values()))
    axes[0].plot(n, shares[:, 1], "o-", color="#0b5394", label="on the tails")
    axes[0].plot(n, shares[:, 2], "o-", color="#b45309", label="beside them")
    axes[0].set(xlabel="wires each way", ylabel="share of the light", ylim=(0, None))
    axes[0].legend(fontsize=7)
    for ax, count in ((axes[1], 2),):
        pupil = filtered(DIAMETER_M, MESH.wires(count), MESH.wires(count), 600, 2.0)
        image = image_by_fft(pupil, LASER_M)
        middle = image.intensity.shape[0] // 2
        near = slice(middle - 220, middle + 221)
        edge = 220 * image.step_rad * 1e3
        ax.imshow(
            np.log10(image.intensity[near, near] / image.intensity.max() + 1e-12),
            extent=[-edge, edge, -edge, edge],
            vmin=-6,
            vmax=0,
            cmap="inferno",
            origin="lower",
        )
        ax.grid(visible=False)
        ax.set(title=f"{count} wires each way, log", xlabel="p (mrad)", ylabel="q (mrad)")
