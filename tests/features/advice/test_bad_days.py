"""Is ambiguity worse than yesterday, and why: asked of the console's pages from the overview on."""

import html
import re

import httpx
import pytest

from service.times import HOUR_S, bucket_start, utc_now
from tests.features.advice.bad_days import CASES, two_days

BATCHES = 48
STARS = r"([\d\N{NARROW NO-BREAK SPACE}]+) of ([\d\N{NARROW NO-BREAK SPACE}]+) stars"


def text_of(part):
    return re.sub(r"\s+", " ", html.unescape(re.sub(r"<[^>]+>", " ", part)))


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    """Overview row of each spacecraft, the page of its change, its advice, and its alarm."""
    end = bucket_start(utc_now().bucket(HOUR_S), HOUR_S)
    with (
        two_days(tmp_path_factory.mktemp("days"), end, BATCHES) as address,
        httpx.Client(base_url=address, timeout=120) as client,
    ):
        overview, found = client.get("/").raise_for_status().text, {}
        for case in CASES:
            (row,) = re.findall(
                rf"<tr[^>]*>(?:(?!</tr>).)*/{case.name}\?(?:(?!</tr>).)*</tr>", overview, re.DOTALL
            )
            link = html.unescape(re.search(r'href="([^"]*before=day[^"]*)"', row)[1])
            page = client.get(link).raise_for_status().text
            best = re.search(r'href="(/advice/[^"]*)#best"', page)[1]
            advice = client.get(html.unescape(best)).raise_for_status().text
            critical = re.search(r'href="(/alarms/[0-9A-Z]{26})"', row)
            alarm = client.get(critical[1]).raise_for_status().text if critical else ""
            found[case.name] = row, page, advice, alarm
        yield found


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_the_change_leads_to_its_cause_and_to_the_same_figures(pages, case):
    row, page, *_ = pages[case.name]
    title = re.search(r'before=day[^>]*title="([^"]*)"', row)[1]
    panel = text_of(re.search(r'<div id="why".*?</section>', page, re.DOTALL)[0])
    told = re.search(
        rf"ambiguous stars \w+ before.*?: (\S+) percentage points, {STARS}.*?, before {STARS}",
        panel,
    )
    assert told, panel
    assert f"{told[1]} in {told[3]}" in text_of(row)
    assert title.removeprefix("Within chance: ") == (
        f"{told[2]} of {told[3]} stars in the last day, {told[4]} of {told[5]} the day before"
    )
    causes = re.findall(r"<li><strong>(.*?)</strong>", page)
    if case.cause:
        assert "▲ More ambiguous stars than before" in panel
        assert "▲" in text_of(re.search(r"before=day.*?</a>", row, re.DOTALL)[0])
        assert html.unescape(causes[0]) == case.cause
    else:
        assert "As many ambiguous stars as before, within chance" in panel
        assert "≈" in row
        assert causes == []


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_the_page_of_an_alarm_names_the_cause_found_before_the_usual_one(pages, case):
    text = text_of(pages[case.name][3])
    assert ("Cause found in the records" in text) is bool(case.cause)
    if case.cause:
        assert case.cause in text.partition("Otherwise the usual cause")[0], text


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_the_one_setting_stands_behind_the_remedy_of_the_cause(pages, case):
    advice = pages[case.name][2]
    best = text_of(re.search(r'<section class="advice" id="best">.*?</section>', advice, re.S)[0])
    if " ambiguous instead of " not in best:
        assert "No single setting of the identifier" in best
    elif case.cause:
        assert f"The cause in the last day comes first: {case.cause} →" in best
        assert best.index("→") < best.index(" ambiguous instead of ")
    else:
        assert "comes first" not in best
