"""The OpenAPI document and how routes describe themselves."""
