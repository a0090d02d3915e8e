"""From an estimate to the controller's next setting."""
