"""Examples of a webhook, from its registration to its end."""

from service.web.examples import API, Json, Walk


def send(walk: Walk) -> None:
    """Use a receiver whose name is unknown (RFC 2606), so that no message leaves this machine."""
    client, take = walk.client, walk.take
    here = f"{API}/webhooks"
    asked = {
        "name": "pager",
        "url": "https://receiver.invalid/acquire",
        "kinds": ["alarm"],
        "severity": "warning",
    }
    added = take("add_webhook", client.post(here, json=asked), "alarms", asked)
    inside = asked | {"url": "https://169.254.169.254/latest/meta-data"}
    take("add_webhook", client.post(here, json=inside), "not_a_public_address")
    take("list_webhooks", client.get(here), "one")
    webhook = f"{here}/{added['id']}"
    take("test_webhook", client.post(f"{webhook}/test"), "unknown_name")
    hours = {"previous_hours": 24}
    rotated = client.post(f"{webhook}/secret", json=hours)
    take("rotate_webhook_secret", rotated, "new_secret", hours)
    every = asked | {"kinds": None, "spacecraft": ["XTE"], "run": "*", "enabled": False}
    take("change_webhook", client.put(webhook, json=every), "paused", every)
    take("test_webhook", client.post(f"{webhook}/test"), "paused")
    period = {"since": "1999-03-01T00:00:00.000Z", "until": "1999-03-02T00:00:00.000Z"}
    replayed = client.post(f"{webhook}/replay", json=period)
    take("replay_events", replayed, "none_in_the_period", period)
    every_letter: Json = {"events": None}
    retried = client.post(f"{webhook}/retry", json=every_letter)
    take("retry_dead_letters", retried, "none_is_dead", every_letter)
    take("list_webhook_deliveries", client.get(f"{webhook}/deliveries"), "none_waits")
    take("get_webhook", client.get(webhook), "paused")
    take("delete_webhook", client.delete(webhook), "deleted")
    take("get_webhook", client.get(webhook), "unknown")
