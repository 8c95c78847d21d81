"""What the handlers of API and console share: access, bodies, parameters, responses, problems."""
