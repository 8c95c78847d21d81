"""A measured quantity is added as CONTRIBUTING says: two entries and a migration, no more."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from service.resources import shipped
from service.trends.measures import MeasuredOfBatch
from service.trends.quantities import Quantity

ROOT = Path(__file__).parents[2]
HEAD = max(each.stem[:4] for each in shipped("migrations", "versions").glob("[0-9]*.py"))
NEXT = f"{int(HEAD) + 1:04}"

MIGRATION = f'''"""Faintest star of batches and trackers, and its rollups."""

import sqlalchemy as sa
from alembic import op

revision = "{NEXT}"
down_revision = "{HEAD}"

NAME = "faintest_mag"
ROLLUPS = ("rollups_hourly", "rollups_daily", "tracker_rollups_hourly", "tracker_rollups_daily")
BY_SPACECRAFT = (
    *("spacecraft", "run", "time_ns", "batch_id", "status", "unique", "ambiguous", "unmatched"),
    *("residual_rms_arcsec", "predicted_rms_arcsec", "magnitude_offset_mag", "a_priori_angle_deg"),
    *("scale_offset_ppm", "alignment_offset_arcsec"),
)
CURRENT = {{"sqlite_where": sa.text("current = 1"), "postgresql_where": sa.text("current")}}


def upgrade() -> None:
    for table in ("results", "tracker_values"):
        op.add_column(table, sa.Column(NAME, sa.Double()))
    for table in ROLLUPS:
        for part, kind in (("n", sa.BigInteger()), ("sum", sa.Double())):
            zero = {{"server_default": sa.text("0"), "nullable": False}}
            op.add_column(table, sa.Column(f"{{NAME}}_{{part}}", kind, **zero))
        for end in ("min", "max"):
            op.add_column(table, sa.Column(f"{{NAME}}_{{end}}", sa.Double()))
    # A trend over batches reads this index only: the new value is its last column.
    op.drop_index("ix_results_current_by_spacecraft", "results")
    columns = [*BY_SPACECRAFT, NAME]
    op.create_index("ix_results_current_by_spacecraft", "results", columns, **CURRENT)
'''

ADDED = """
import json, sys
from pathlib import Path
from service import resources

# The migrations of a newcomer's checkout.
shipped = resources.shipped
resources.shipped = lambda *parts: (
    Path(sys.argv[1], *parts[1:]) if parts[0] == "migrations" else shipped(*parts)
)

from service.trends.limits import above
from service.trends.measures import STORED, Measured
from service.trends.quantities import QUANTITIES, Quantity


def faintest_mag(stars):
    found = [
        float(mag)
        for k in stars.trackers
        for mag, row in zip(
            stars.batch.corrected[k].magnitude_mag, stars.batch.star[k], strict=True
        )
        if row >= 0
    ]
    return max(found, default=None)


# service/trends/measures.py
STORED["faintest_mag"] = Measured(faintest_mag, rolled_up=True)
# service/trends/quantities.py
QUANTITIES["faintest_mag"] = Quantity(
    "faintest_mag",
    "mag",
    "faintest star",
    STORED["faintest_mag"],
    lambda mission: above(-9.0, -8.0, -7.0, minimum_count=1, duration_s=0.0),
    by_tracker=True,
)
"""

USED = """
from service.app.factory import open_app
from service.features.alarms.part import Alarms
from service.missions.mission import load_missions
from service.settings import Settings
from service.sky.cache import LruCache
from service.sky.catalog.star_catalog import load_embedded
from service.sky.model import SkyModel
from service.storage.sql import migrations
from tests.storage.twin import FIRST, SECOND, submission, twin

database = "sqlite:///" + sys.argv[2]
sky, mission = SkyModel(load_embedded(), LruCache(64 << 20)), twin(load_missions())
app = open_app(Settings(database=database, replay_processes=0), mission)
name = "faintest_mag"
answers = [
    json.loads(app.submissions.submit(submission(sky, mission, f"b{k}", after_s=30.0 * k)).body)
    for k in range(3)
]
series = {
    of: app.spacecraft.history(
        "XTE", quantities=[name], strategy="latest", tracker=of or None
    ).series[name].value
    for of in ("", FIRST, SECOND)
}
day = app.spacecraft.history("XTE", quantities=[name], size=1).series[name].mean
limits = {
    each.quantity: each.settings["critical"]["high"]
    for each in app.part(Alarms).limits.all("XTE", FIRST)
}
alarms = sorted(each.tracker or "" for each in app.part(Alarms).active() if each.quantity == name)
ranked = app.spacecraft.ranking("XTE", by=name)
app.close()
found = {"answers": answers, "series": series, "day": day, "limit": limits[name]}
found |= {"alarms": alarms, "worst": len(ranked.items), "schema": migrations.check(database)}
print(json.dumps(found))
"""


@pytest.fixture(scope="module")
def checkout(tmp_path_factory):
    """Migrations with the one of the new quantity."""
    folder = tmp_path_factory.mktemp("checkout") / "versions"
    folder.mkdir()
    for file in [*shipped("migrations", "versions").glob("*.py")]:
        (folder / file.name).write_text(file.read_text("utf-8"), "utf-8")
    for name in ("env.py", "script.py.mako"):
        if (file := shipped("migrations", name)).is_file():
            (folder.parent / name).write_text(file.read_text("utf-8"), "utf-8")
    (folder / f"{NEXT}_faintest.py").write_text(MIGRATION, "utf-8")
    return folder.parent


def test_a_measured_quantity_has_values_of_batches_and_trackers_limits_and_alarms(
    checkout, tmp_path
):
    run = subprocess.run(
        [sys.executable, "-c", ADDED + USED, str(checkout), str(tmp_path / "acquire.db")],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert run.returncode == 0, run.stderr
    found = json.loads(run.stdout.splitlines()[-1])
    assert found["schema"] == []
    # The batch has the faintest of all its stars, each tracker that of its own.
    pairs = zip(
        *(found["series"][name] for name in ("STARTRACKER_1", "STARTRACKER_2")), strict=True
    )
    whole = found["series"][""]
    assert len(whole) == 3
    for both, each in zip(whole, pairs, strict=True):
        assert None not in each
        assert both == max(each)
    assert found["day"] == [pytest.approx(sum(whole) / 3)]
    assert found["limit"] == -7.0
    assert found["alarms"] == ["", "STARTRACKER_1", "STARTRACKER_2"]
    assert found["worst"] == 3


def test_a_value_of_the_batch_as_a_whole_cannot_be_declared_by_tracker():
    """It would be null for every tracker, and nothing would say why."""
    whole = MeasuredOfBatch(lambda acquisition: 1.0)
    with pytest.raises(ValueError, match="one: no tracker has a value"):
        Quantity("one", "1", "one", whole, by_tracker=True)
