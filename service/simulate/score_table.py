"""Scores as a table: a row for nominal stretches and one for those with errors."""

from service.simulate.score import Score, together


def table(scores: dict[str, dict[str, Score]]) -> str:
    """For each mission a line of the nominal stretches and one of those with errors."""
    head = (
        f"{'':<15}{'batches':>8}{'stars':>7}{'unique':>9}{'ambig.':>8}{'unmatch.':>9}{'wrong':>8}"
        f"{'attitudes':>11}{'error':>8}{'sigma':>7}{'within':>8}{'solve':>8}{'whole':>8}"
    )
    units = (
        f"{'':<15}{'':>8}{'':>7}{'%':>9}{'%':>8}{'%':>9}{'%':>8}"
        f"{'':>11}{'arcsec':>8}{'arcsec':>7}{'%':>8}{'µs':>8}{'µs':>8}"
    )
    lines = [head, units]
    for name, stretches in scores.items():
        lines.append(_row(f"{name} nominal", stretches.get("nominal", Score())))
        serious = [each for kind, each in stretches.items() if kind != "nominal"]
        lines.append(_row(f"{name} serious", together(serious)))
    notes = (
        "nominal: the a priori error that the mission allows for; serious: a growing attitude",
        "error and false stars.  wrong: reported as unique, but not the true star.  error, sigma:",
        "one sigma along the attitude's worst axis, as measured and as predicted by the",
        "covariance.  within: attitudes inside their own 99.7 % region.  solve:",
        "identification and solution; whole: zone and recording too; medians of a batch.",
    )
    return "\n".join([*lines, "", *notes])


def _row(title: str, of: Score) -> str:
    return (
        f"{title:<15}{of.batches:>8}{of.stars['observed']:>7}{of.percent('unique'):>9.2f}"
        f"{of.percent('ambiguous'):>8.2f}{of.percent('unmatched'):>9.2f}{of.percent('wrong'):>8.2f}"
        f"{of.attitudes:>11}{of.seen_sigma_arcsec:>8.2f}{of.predicted_sigma_arcsec:>7.2f}"
        f"{of.within_percent:>8.2f}{of.median_solving_us:>8.0f}{of.median_whole_us:>8.0f}"
    )
