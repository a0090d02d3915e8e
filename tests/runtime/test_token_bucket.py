"""Tokens at once, and at a rate later on."""

from servotwin.runtime.token_bucket import TokenBucket


def test_all_tokens_at_once_and_then_as_many_as_the_time_gives() -> None:
    now = 100.0
    bucket = TokenBucket(3.0, 0.5, lambda: now)
    assert [bucket.take() for _ in range(5)] == [True, True, True, False, False]
    taken = 0
    for _ in range(40):
        now += 0.25
        taken += bucket.take()
    assert taken == 5  # of 10 s
    now += 1000.0
    assert [bucket.take() for _ in range(4)] == [True, True, True, False]
