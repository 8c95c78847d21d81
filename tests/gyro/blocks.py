"""Gyro blocks as they are sent."""

START = "1999-03-01T00:00:00.000Z"


def body(block="g1", *, start=START, times_s=None, step_s=None, samples=5, run="live", rng=None):
    """The JSON of a block; without times or a step the samples are .1 s apart."""
    if times_s is None and step_s is None:
        step_s = 0.1
    samples = samples if times_s is None else len(times_s)
    told = {"block": block, "start": start, "run": run}
    told |= {"step_s": step_s} if times_s is None else {"times_s": list(times_s)}
    if rng is None:
        rates = [[1e-3, -2e-5 * k, 0.0] for k in range(samples)]
    else:
        rates = rng.normal(0.0, 1e-3, (samples, 3)).tolist()
    return told | {"rates_rad_per_s": rates}
