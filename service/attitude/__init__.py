"""WHERE WE POINT: matched vectors to an attitude with its covariance."""
