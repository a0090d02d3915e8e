"""How soon the edge notices that the gap has changed, how often it is wrong, and what that saves."""
