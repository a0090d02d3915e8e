"""Small matrices as tuples of rows, for edges without numpy: product, exponential, zero-order hold, rest."""

from collections.abc import Sequence
from math import frexp

Rows = tuple[tuple[float, ...], ...]
"""A matrix, row by row."""
# Terms of the exponential's series for a norm of at most one half: the next one is below 1e-19.
_TERMS = 15
# A pivot this much smaller than its row's largest number is rounding: the state is free.
_ROUNDING = 1e-13


def multiplied(first: Rows, second: Rows) -> Rows:
    """Product of two matrices."""
    columns = tuple(zip(*second, strict=True))
    return tuple(tuple(sum(a * b for a, b in zip(row, column, strict=True)) for column in columns) for row in first)


def exponential(matrix: Rows) -> Rows:
    """Matrix exponential, by its series on a halved matrix that is then squared."""
    n = len(matrix)
    norm = max(sum(abs(value) for value in row) for row in matrix)
    squarings = max(0, frexp(norm)[1] + 1)
    scale = 0.5**squarings
    small = tuple(tuple(value * scale for value in row) for row in matrix)
    identity = tuple(tuple(1.0 if i == j else 0.0 for j in range(n)) for i in range(n))
    # Of the exponential less one: the squarings would round away what differs little from one.
    total: Rows = tuple(tuple(0.0 for _ in row) for row in matrix)
    for k in range(_TERMS, 0, -1):
        raised = tuple(tuple(a + b for a, b in zip(*pair, strict=True)) for pair in zip(total, identity, strict=True))
        total = tuple(tuple(value / k for value in row) for row in multiplied(small, raised))
    for _ in range(squarings):
        square = multiplied(total, total)
        total = tuple(
            tuple(2.0 * a + b for a, b in zip(*pair, strict=True)) for pair in zip(total, square, strict=True)
        )
    return tuple(tuple(a + b for a, b in zip(*pair, strict=True)) for pair in zip(total, identity, strict=True))


def zero_order_held(A: Rows, B: Rows, step: float) -> tuple[Rows, Rows]:
    """(A, B) over `step` seconds of x' = A x + B u with u constant."""
    n, inputs = len(A), len(B[0]) if B else 0
    if n == 0:
        return A, B
    rows = [tuple(value * step for value in (*a, *b)) for a, b in zip(A, B, strict=True)]
    advanced = exponential((*rows, *(((0.0,) * (n + inputs),) * inputs)))
    return tuple(row[:n] for row in advanced[:n]), tuple(row[n:] for row in advanced[:n])


def at_rest(A: Rows, driven: Sequence[float], known: dict[int, float]) -> tuple[float, ...]:
    """State x = A x + driven of a sampled law, with some of its states given.

    A state that may rest anywhere (an integrator) rests at zero; an equation that cannot be met is left out.
    """
    n = len(A)
    free = [i for i in range(n) if i not in known]
    rows = [
        [(1.0 if i == j else 0.0) - A[i][j] for j in free] + [driven[i] + sum(A[i][j] * known[j] for j in known)]
        for i in free
    ]
    size = max((abs(value) for row in rows for value in row[:-1]), default=0.0)
    places: list[tuple[int, int]] = []
    for column in range(len(free)):
        first = len(places)
        if first == len(rows):
            break
        best = max(range(first, len(rows)), key=lambda i: abs(rows[i][column]))
        if abs(rows[best][column]) <= _ROUNDING * size:
            continue
        rows[first], rows[best] = rows[best], rows[first]
        for i, row in enumerate(rows):
            if i != first and row[column] != 0.0:
                factor = row[column] / rows[first][column]
                rows[i] = [a - factor * b for a, b in zip(row, rows[first], strict=True)]
        places.append((first, column))
    found = dict(known)
    for first, column in places:
        found[free[column]] = rows[first][-1] / rows[first][column]
    return tuple(found.get(i, 0.0) for i in range(n))
