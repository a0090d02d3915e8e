"""Settings that an edge starts with, made of a servo's model and a policy."""
