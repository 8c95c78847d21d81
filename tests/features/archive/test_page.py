"""The page of runs shows the reprocessings into the archive."""

import httpx
from msgspec import structs

from service.app.factory import open_app
from service.features.archive.reprocessing import Reprocessing, write_reprocessing
from service.times import shifted, utc_now
from service.web.app import create_app
from tests.web.serving import Server, in_process_settings
from tests.web.test_revisions_and_runs import text_of


def test_the_runs_page_tells_how_far_a_reprocessing_into_the_archive_is(
    chosen_database, drawn, tmp_path
):
    settings = in_process_settings(chosen_database(), archive_folder=tmp_path)
    now = utc_now()
    begun = Reprocessing(
        run="wider",
        source="live",
        partitions=365,
        partitions_done=73,
        batches=100_000,
        before=10_000,
        recorded=9_990,
        refused=10,
        started=shifted(now, -100.0).text,
        updated=now.text,
        finished=None,
    )
    stopped = structs.replace(begun, run="tight", updated=shifted(now, -90.0).text)
    ended = structs.replace(begun, run="again", partitions_done=365, finished=now.text)
    for each in (begun, stopped, ended):
        write_reprocessing(tmp_path, each)
    with Server(create_app(open_app(settings))) as url:
        page = text_of(httpx.get(f"{url}/runs", timeout=60))
    assert "wider live ▸ running 73 of 365 19 990 100 13 min 20 s 10" in page
    assert "tight live ‖ interrupted" in page
    assert "again live ● done 365 of 365" in page
