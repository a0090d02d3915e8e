"""`servotwin twin test-alarm`: post a test to the webhook of a twin's file."""

from __future__ import annotations

import time
from pathlib import Path

from servotwin.errors import InvalidInput
from servotwin.twin_service.twin_file import service_of
from servotwin.twin_service.webhook import WebhookAway, WebhookRefused, alarm_post, send_post


def post_test_alarm(config: Path) -> None:
    """Post one test alarm, and print what the webhook answered.

    Raises
    ------
    InvalidInput
        The file names no webhook, or the webhook does not take the test.
    """
    webhook = service_of(config).webhook
    if webhook is None:
        raise InvalidInput(f"{config}: has no [service.webhook], so that no alarm is posted")
    try:
        status = send_post(webhook, alarm_post("test", "alarm", "this is a test of the webhook", time.time()))
    except (WebhookAway, WebhookRefused) as error:
        raise InvalidInput(f"{config}: service.webhook: {error}") from None
    print(f"webhook at {webhook.host}: took the test (status {status})")
