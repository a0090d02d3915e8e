"""Speed and accuracy beside what one would use instead, measured side by side in one run."""
