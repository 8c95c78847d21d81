"""Examples of a picture: one that is solved, and one that is cut off."""

from service.web.examples import API, Walk


def send(walk: Walk) -> None:
    """Send a frame of a tracker as a picture of a camera."""
    _, file = walk.frame()
    octets = {"Content-Type": "application/octet-stream"}
    solve = f"{API}/pictures?spacecraft=IMAGER"
    solved = walk.client.post(solve, content=file, headers=octets)
    del walk.take("solve_picture", solved, "found")["stars"][2:]
    cut_off = walk.client.post(solve, content=file[:5760], headers=octets)
    walk.take("solve_picture", cut_off, "cut_off")
