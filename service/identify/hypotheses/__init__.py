"""Star identification by the posterior of hypotheses: the identifier `verified`."""
