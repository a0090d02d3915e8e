"""The guard against leaks must catch leaks: a small suite of its own, two of whose tests leak."""

import pytest

pytest_plugins = ["pytester"]

SUITE = """
import asyncio, gc, threading

def test_clean():
    asyncio.run(asyncio.sleep(0))
    thread = threading.Thread(target=lambda: None)
    thread.start()

def test_thread():
    threading.Thread(target=threading.Event().wait, daemon=True).start()

def test_task():
    loop = asyncio.new_event_loop()
    task = loop.create_task(asyncio.sleep(60))
    loop.run_until_complete(asyncio.sleep(0))
    del task
    loop.close()
    del loop
    gc.collect()
"""


@pytest.mark.slow
def test_a_leak_fails_the_test_that_leaks(pytester, request):
    pytester.makeconftest((request.path.parent / "conftest.py").read_text())
    pytester.makepyfile(SUITE)
    done = pytester.runpytest_subprocess("-p", "no:xdist", "-p", "no:schemathesis", "-rE")
    done.assert_outcomes(passed=3, errors=2)
    done.stdout.fnmatch_lines_random(["ERROR *::test_thread*", "ERROR *::test_task*"])
