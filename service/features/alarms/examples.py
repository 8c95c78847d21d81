"""Examples of limits, and of an alarm with the actions on it."""

from service.web.examples import API, Walk


def send(walk: Walk) -> None:
    """Send them in the order in which they depend on each other."""
    client, take = walk.client, walk.take
    here = f"{API}/spacecraft/SWAS/limits"
    settings = {"warning": {"high": 0.5}, "minimum_count": 2, "duration_s": 0}
    asked = {"settings": settings, "who": "J. Operator", "comment": "for the next pass"}
    limit = f"{here}/no_attitude_share"
    tried = {"settings": settings}
    preview = client.post(f"{limit}/preview", json=tried)
    take("preview_limit", preview, "of_one_batch", tried)
    take("set_limit", client.put(limit, json=asked), "changed", asked)
    take("get_limit", client.get(limit), "with_history")
    take("list_limits", client.get(here), "of_swas")
    client.put(f"{API}/runs/pass-8", json={"alarms": True})
    lone = walk.drawn("SWAS", stars=1)
    for name in ("1999-060-0001", "1999-060-0002"):
        client.post(f"{API}/batches", json=lone | {"batch": name, "run": "pass-8"})
    found = take("list_alarms", client.get(f"{API}/alarms?run=pass-8"), "open")
    alarm = f"{API}/alarms/{found['items'][0]['id']}"
    said = {"who": "J. Operator", "comment": "one star in view"}
    shelved = {**said, "minutes": 60}
    take("shelve_alarm", client.post(f"{alarm}/shelve", json=shelved), "an_hour", shelved)
    take("unshelve_alarm", client.post(f"{alarm}/unshelve", json=said), "back", said)
    take("comment_alarm", client.post(f"{alarm}/comment", json=said), "said", said)
    acknowledge = f"{alarm}/acknowledge"
    take("acknowledge_alarm", client.post(acknowledge, json=said), "seen", said)
    take("acknowledge_alarm", client.post(acknowledge, json=said), "seen_before")
    take("get_alarm", client.get(alarm), "with_what_was_done")
    take("reset_limit", client.delete(f"{limit}?who=J.%20Operator"), "shipped_again")
