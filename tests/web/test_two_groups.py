"""Reflections in a tracker, from the batch that is posted to the pages that show it."""

import math
import re

import numpy as np
import pytest

from service.vectors import rotate_about

SHIFT_DEG = 0.2
RUN = "reflections"


@pytest.fixture
def reflected(drawn):
    """A batch of six stars, each with a reflection as bright 0.2 deg away."""

    def made(number):
        batch = drawn("XTE", number + 1, stars=6, seed=11)[number]
        (seen,) = batch["observations"]
        turn = np.array([math.radians(SHIFT_DEG), 0.0, 0.0])
        ghosts = [
            star | {"vector": rotate_about(turn, np.array(star["vector"])).tolist()}
            for star in seen["stars"]
        ]
        return batch | {
            "run": RUN,
            "batch": f"reflected-{number}",
            "observations": [seen | {"stars": seen["stars"] + ghosts}],
        }

    return made


def test_an_answer_with_two_groups_of_stars_is_suspect_and_names_the_rival(post, reflected, client):
    answer = post(reflected(0)).json()
    attitude = answer["attitude"]
    assert attitude["status"] == "suspect"
    rival = attitude["rival"]
    assert rival["angle_deg"] == pytest.approx(SHIFT_DEG, abs=0.02)
    assert 0.0 < rival["probability"] <= 0.5
    (stars,) = rival["stars"]
    assert len(stars) == 12
    assert sum(star is not None for star in stars) >= 3
    assert any(text.startswith("rival_attitude: ") for text in answer["warnings"])

    page = client.get(f"/batches/{answer['id']}").text
    text = re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", page))
    assert "Two groups of stars give two attitudes" in text

    listed = client.get("/api/v1/batches", params={"run": RUN, "status": "suspect"}).json()
    assert answer["id"] in [item["id"] for item in listed["items"]]


def test_the_advice_tells_of_batches_with_two_groups(post, reflected, client):
    for number in range(3):
        assert post(reflected(number)).status_code in (200, 201)
    advice = client.get("/api/v1/spacecraft/XTE/advice", params={"run": RUN}).json()
    (said,) = advice["groups"]
    assert said["action"] == "correct"
    assert "In 3 of 3 batches two groups of stars" in said["text"]
    page = client.get("/advice/XTE", params={"run": RUN}).text
    assert "two groups of stars have each an attitude of their own" in page
