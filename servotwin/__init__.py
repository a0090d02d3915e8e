"""A digital twin that keeps a motion controller tuned while its machine wears."""
