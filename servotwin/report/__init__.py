"""One style for figures and pages."""
