"""Speed and accuracy beside other solvers, measured in one run."""
