"""Current results with their attitudes, in order of time, in pages of any size."""

import itertools
import json

import numpy as np
import pytest

from service.app.factory import open_app
from service.features.products.result_tables import attitude_pages
from service.observations.schema import submission_from_json
from service.settings import Settings
from service.storage.queries.pages import ResultFilter, count
from tests.storage.samples import KINDS, batch

pytestmark = pytest.mark.both_databases


@pytest.fixture
def app(database, sky, missions):
    app = open_app(Settings(database=database, replay_processes=0))
    for number in range(12):
        sent = json.loads(
            batch(sky, missions, f"b{number}", kind=KINDS[number % 3], after_s=100.0 - number // 2)
        )
        if number % 4 == 0:
            sent["body_rates_deg_per_s"] = [0.0, 0.25, -1e-7]
        app.submissions.submit(submission_from_json(json.dumps(sent)))
    yield app
    app.close()


def test_every_result_is_read_once_in_order_in_pages_of_any_size(app):
    listed = {each.id: each for each in app.spacecraft.attitudes("XTE", limit=500).items}
    for newest_first, page in itertools.product((False, True), (1, 5, 12, 100)):
        pages = list(
            attitude_pages(
                app.context.reading,
                app.store.archive,
                ResultFilter("live", "XTE"),
                newest_first=newest_first,
                page=page,
            )
        )
        times = np.concatenate([each.time_ns for each in pages])
        assert len({id for each in pages for id in each.id}) == len(times) == 12
        assert (np.diff(times) <= 0 if newest_first else np.diff(times) >= 0).all()
        assert max(len(each) for each in pages) <= page
        for each in pages:
            check(each, listed)
    with app.context.reading() as connection:
        for most, counted in ((100, 12), (7, 7)):
            assert (
                count(connection, app.store.archive, ResultFilter("live", "XTE"), most) == counted
            )


def check(page, listed):
    """A page against the list of attitudes."""
    for k, id in enumerate(page.id):
        if id in listed:
            assert page.quaternion[k].tolist() == listed[id].quaternion
            assert page.status[k] == listed[id].status
            cov = listed[id].covariance_arcsec2
            wanted = [cov[i][j] for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))]
            assert page.covariance_arcsec2[k].tolist() == wanted
        else:
            assert page.status[k] is None
            assert np.isnan(page.quaternion[k]).all()
        rate = page.rate_deg_per_s[k]
        is_own = int(page.batch[k][1:]) % 4 == 0
        assert rate.tolist() == [0.0, 0.25, -1e-7] if is_own else np.isnan(rate).all()
