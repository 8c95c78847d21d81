"""The laboratory of the report: its aperture, laser and 18-mesh screen."""

from studies.star_image_report.wires import INCH_M, Mesh

DIAMETER_M = 0.542 * INCH_M
LASER_M = 632.8e-9
MESH = Mesh(INCH_M / 18.0, 0.011 * INCH_M)
