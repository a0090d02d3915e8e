"""Parts common to the estimators: contacts, response of the structure, projection, noise."""
