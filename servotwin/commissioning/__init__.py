"""Settings that an edge starts with, derived from a servo's model and a policy."""
