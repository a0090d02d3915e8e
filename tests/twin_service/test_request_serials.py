"""Serials of requests over a broker: one that comes again, as where somebody replays it, is recognised."""

from random import Random

from servotwin.twin_service.request_serials import RequestSerials


def test_a_request_that_comes_again_is_recognised_however_late() -> None:
    serials = RequestSerials()
    assert all(serials.is_new("axis-1", "b1", serial) for serial in range(1000, 9000))
    assert not any(serials.is_new("axis-1", "b1", serial) for serial in range(1000, 9000))
    assert serials.is_new("axis-1", "b1", 9000)


def test_requests_that_overtake_each_other_are_all_new_once() -> None:
    order = list(range(2**52 - 300, 2**52 + 300))
    for begin in range(0, len(order), 50):
        Random(begin).shuffle(part := order[begin : begin + 50])
        order[begin : begin + 50] = part
    serials = RequestSerials()
    assert [serials.is_new("axis-1", "b1", serial) for serial in order] == [True] * len(order)
    assert [serials.is_new("axis-1", "b1", serial) for serial in order] == [False] * len(order)


def test_links_runs_and_servos_count_apart() -> None:
    serials = RequestSerials()
    links = [(servo, run, begin) for servo in ("axis-1", "axis-2") for run in ("b1", "b2") for begin in (5, 2**50)]
    for step in range(3):
        assert all(serials.is_new(servo, run, begin + step) for servo, run, begin in links)
    assert not any(serials.is_new(servo, run, begin) for servo, run, begin in links)


def test_the_links_of_a_servo_that_are_remembered_are_bounded_and_those_in_use_stay() -> None:
    serials = RequestSerials()
    for number in range(1000):
        assert serials.is_new("axis-1", "now", number)
        assert serials.is_new("axis-1", f"b{number}", 7)
    assert len(serials._links["axis-1"]) < 100
    assert not serials.is_new("axis-1", "now", 0)
