"""The shapes of answers, for the API's description; the answers themselves are not built here."""
