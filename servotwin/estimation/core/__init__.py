"""Parts that the estimators share: contacts, the structure's response, projection, noise."""
