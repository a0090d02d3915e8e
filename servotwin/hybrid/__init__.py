"""An exact kernel for piecewise-affine hybrid automata."""
