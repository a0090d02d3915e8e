"""The pool of processes that computes a map."""

import time
import warnings

import pytest

from servotwin.analysis.maps.pool import shared, workplace


def wait_and_return(task: int) -> int:
    time.sleep(0.2)
    return task


@pytest.mark.slow
def test_closing_with_unfinished_tasks_gives_no_warning():
    """As Ctrl-C does: joblib's warning would stand before the message."""
    with workplace(workers=2), warnings.catch_warnings(record=True) as noted:
        warnings.simplefilter("always")
        outcomes = shared(wait_and_return, range(20))
        next(outcomes)
        outcomes.close()
    assert [str(one.message) for one in noted] == []
