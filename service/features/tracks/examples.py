"""Example of a track: a point that moves."""

from service.web.examples import API, Json, Walk


def send(walk: Walk) -> None:
    """Send four batches a second apart, in which one point moves among three stars."""
    client = walk.client
    batch = walk.drawn("XTE", stars=3) | {"run": "pass-9"}
    (seen,) = batch["observations"]
    for k in range(4):
        point = {"vector": [0.01 + 1e-4 * k, 0.02, 0.99975], "magnitude": 5.0}
        own: Json = {"batch": f"1999-060-t{k}", "time": f"1999-03-01T00:00:{10 + k}.000Z"}
        own["observations"] = [seen | {"stars": [*seen["stars"], point]}]
        client.post(f"{API}/batches", json=batch | own).raise_for_status()
    here = f"{API}/spacecraft/XTE/tracks"
    walk.take("list_tracks", client.get(f"{here}?run=pass-9"), "one_moves")
