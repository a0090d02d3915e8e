"""The guard against leaks must catch leaks: each test below runs a small suite of its own, whose one test leaks."""

import pytest

pytest_plugins = ["pytester"]

THREAD = """
import threading

def test_thread():
    threading.Thread(target=threading.Event().wait, daemon=True).start()
"""

TASK = """
import asyncio, gc

def test_task():
    loop = asyncio.new_event_loop()
    task = loop.create_task(asyncio.sleep(60))
    loop.run_until_complete(asyncio.sleep(0))
    del task
    loop.close()
    del loop
    gc.collect()
"""

CLEAN = """
import asyncio, threading

def test_clean():
    asyncio.run(asyncio.sleep(0))
    thread = threading.Thread(target=lambda: None)
    thread.start()
"""


@pytest.mark.slow
@pytest.mark.parametrize(("body", "errors"), [(THREAD, 1), (TASK, 1), (CLEAN, 0)])
def test_a_leak_fails_the_test_that_leaks(pytester, request, body, errors):
    pytester.makeconftest((request.path.parent / "conftest.py").read_text())
    pytester.makepyfile(body)
    pytester.runpytest_subprocess("-p", "no:xdist", "-p", "no:schemathesis").assert_outcomes(passed=1, errors=errors)
