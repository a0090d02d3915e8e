"""Redesign: the controller's next setting from an estimate."""
