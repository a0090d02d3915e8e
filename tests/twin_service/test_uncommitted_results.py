"""A store that refuses results is told at the beginning, once a minute, and when it is over."""

import logging

import pytest

from servotwin.twin_service.uncommitted_results import UncommittedResults


def test_results_that_are_not_committed_are_logged_once_a_minute_with_their_number(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Two lines a second filled the log, on the very disk perhaps that was full."""
    caplog.set_level(logging.INFO)
    results = UncommittedResults()
    for half_seconds in range(2 * 150):
        results.failed(1000.0 + 0.5 * half_seconds, "ax-1", "the disk is full")
    for _ in range(100):
        results.over()
        results.failed(1150.0, "ax-2", "the disk is full")
    results.failed(1180.0, "ax-2", "the disk is full")
    lines = [(each.message, each.number) for each in caplog.records]
    assert lines == [
        ("result not committed", 1),
        ("result not committed", 121),
        ("result not committed", 241),
        ("results committed again", 300),
        ("result not committed", 101),
    ]
    assert caplog.records[0].servo == "ax-1"
    assert caplog.records[0].why == "the disk is full"
