"""Small systems of equations, solved within compiled functions: a call of numpy takes longer."""

from __future__ import annotations

from servotwin.hybrid.compiled import bare
from servotwin.plant.linear import Complex
from servotwin.plant.signals import Array


@bare
def solve(matrix: Array | Complex, right: Array | Complex) -> None:
    """Solve matrix x = right (k,) into `right`, by elimination with the largest pivots; uses up the matrix (k, k)."""
    size = right.size
    for j in range(size):
        top = j
        for i in range(j + 1, size):
            if abs(matrix[i, j]) > abs(matrix[top, j]):
                top = i
        for k in range(j, size):
            matrix[j, k], matrix[top, k] = matrix[top, k], matrix[j, k]
        right[j], right[top] = right[top], right[j]
        for i in range(j + 1, size):
            share = matrix[i, j] / matrix[j, j]
            for k in range(j + 1, size):
                matrix[i, k] -= share * matrix[j, k]
            right[i] -= share * right[j]
    for j in range(size - 1, -1, -1):
        for k in range(j + 1, size):
            right[j] -= matrix[j, k] * right[k]
        right[j] /= matrix[j, j]
