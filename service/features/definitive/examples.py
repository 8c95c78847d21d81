"""Examples of definitive attitudes: a job, and the live attitude."""

from service.features.definitive.part import Definitive
from service.web.examples import API, Json, Walk


def send(walk: Walk) -> None:
    """Queue a job, and read the filtered attitude of measured ones."""
    client, take = walk.client, walk.take
    here = f"{API}/spacecraft/XTE/definitive-attitude"
    asked: Json = {"run": "none", "start": "1999-03-01T00:00:00Z", "who": "J. Operator"}
    begun = take("make_definitive_attitude", client.post(here, json=asked), "a_day", asked)
    walk.ended(f"{here}/{begun['id']}")
    take("get_definitive_attitude", client.get(f"{here}/{begun['id']}"), "without_batches")
    take("list_definitive_attitudes", client.get(here), "one")
    walk.app.part(Definitive).live_filter.refresh("SWAS")
    take("get_live_attitude", client.get(f"{API}/spacecraft/SWAS/attitude/latest"), "swas")
