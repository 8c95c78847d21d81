"""Links to attitude files, on the page of the definitive attitude."""

from collections.abc import Iterator

from service.features.products.attitude_formats import attitude_formats
from service.features.products.pages import GRADES
from service.features.products.part import Products
from service.web.console.page import PageContext, Panel
from service.web.console.pages.spacecraft import ShownPeriod


def files_of_grades(
    context: PageContext, name: str, run: str, shown: ShownPeriod
) -> Iterator[Panel]:
    """Panel with links to attitude files of each grade that has a good attitude in the period."""
    products = context.app.part(Products)
    series = {
        grade: products.attitudes(name, run=run, start=shown.start, end=shown.end, grade=grade)
        for grade in GRADES
    }
    grades = [grade for grade, each in series.items() if any(True for _ in each.blocks)]
    values = {"name": name, "grades": grades, "formats": attitude_formats()}
    yield Panel("_files_of_grades.html.jinja", values)


PANELS = {"grades_page": files_of_grades}
