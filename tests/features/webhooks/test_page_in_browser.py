"""The page of webhooks in a real browser: made, tried out, paused and deleted."""

import pytest

from tests.features.webhooks.conftest import HERE
from tests.waiting import wait_until
from tests.web.browser import CHROMIUM
from tests.web.fitting import faults

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="there is no chromium on this machine")

STATUS = "document.getElementById('message').textContent"
SHOWN = "[...document.querySelectorAll('[data-webhook] h2')].map(each => each.textContent)"
FILL = "document.querySelector('#new-webhook [name={}]').value = {!r}"
CLICK = "document.querySelector('[data-do={}]').click()"


def test_a_webhook_is_made_tried_paused_and_deleted_on_its_page(service, receiver, browser):
    browser.open(f"{service.url}/webhooks", width=400)
    assert "There are no webhooks" in browser.run("document.body.innerText")
    for name, value in (("name", "<b>pager</b>"), ("url", receiver.url), ("kind", "")):
        browser.run(FILL.format(name, value))
    browser.run("document.querySelector('#new-webhook .main').click()")
    browser.wait(lambda: browser.run(STATUS) == "Added: <b>pager</b>.")
    secret = browser.run("document.getElementById('secret').textContent")
    assert secret.startswith("whsec_")
    browser.wait(lambda: browser.run(SHOWN) == ["<b>pager</b> ● active"])
    (made,) = service.client.get(HERE).json()["items"]
    assert (made["kinds"], made["run"]) == (None, "live")

    browser.run(CLICK.format("test"))
    browser.wait(lambda: browser.run(STATUS).startswith("The receiver answered 204"))
    receiver.answer = lambda handler, _: handler.say(500)
    service.note("fails")
    wait_until(lambda: service.read(made)["last_fault"])
    browser.open(f"{service.url}/webhooks", dark=True)
    assert "status 500" in browser.run("document.querySelector('[data-webhook]').innerText")
    assert faults(browser) == []
    assert browser.run("document.documentElement.scrollWidth <= innerWidth")

    browser.run(CLICK.format("pause"))
    browser.wait(lambda: browser.run(SHOWN) == ["<b>pager</b> ‖ paused"])
    assert service.read(made)["enabled"] is False
    browser.run("document.querySelector('[data-webhook] summary').click()")
    browser.run("document.querySelector('[data-webhook] details button').click()")
    browser.wait(lambda: browser.run(SHOWN) == [])
    assert browser.run(STATUS) == "Deleted: <b>pager</b>."
    assert browser.complaints == []


def test_a_url_that_is_refused_is_told_at_the_form(service, browser):
    browser.open(f"{service.url}/webhooks")
    for name, value in (("name", "inside"), ("url", "https://169.254.169.254/")):
        browser.run(FILL.format(name, value))
    browser.run("document.querySelector('#new-webhook .main').click()")
    browser.wait(lambda: browser.run(STATUS).startswith("Not done: url: 169.254.169.254"))
    assert service.client.get(HERE).json() == {"items": []}
