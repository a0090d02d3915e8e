"""Working memory that is lent, given back, and used again."""

from __future__ import annotations

import pytest

from servotwin.hybrid.buffer_pool import BufferPool


def test_memory_is_used_again_by_the_next_user_of_its_kind() -> None:
    stock: BufferPool[list[int]] = BufferPool(most=2)
    with stock.lent("small", list) as first:
        first.append(1)
    with stock.lent("large", list) as other:
        assert other is not first
    with stock.lent("small", list) as again:
        assert again is first


def test_memory_that_is_lent_is_nobody_elses() -> None:
    stock: BufferPool[list[int]] = BufferPool(most=2)
    with stock.lent("small", list) as one, stock.lent("small", list) as other:
        assert one is not other
    with stock.lent("small", list) as one, stock.lent("small", list) as other:
        assert one is not other


def test_the_oldest_memory_is_dropped_where_too_much_is_kept() -> None:
    stock: BufferPool[list[int]] = BufferPool(most=1)
    with stock.lent("small", list) as first:
        pass
    with stock.lent("large", list):
        pass
    with stock.lent("small", list) as again:
        assert again is not first


def test_memory_in_use_at_an_error_is_not_kept() -> None:
    stock: BufferPool[list[int]] = BufferPool(most=1)
    with pytest.raises(RuntimeError), stock.lent("small", list) as first:
        raise RuntimeError
    with stock.lent("small", list) as again:
        assert again is not first
