"""Compiled code does not check its indices; interpreted it does, once, over everything that the kernel does."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

RUNS = """
import math
from types import SimpleNamespace

import numba
import numpy as np

def interpreted(**options):
    def same(function):
        file = SimpleNamespace(_load_index=dict, _index_path="")
        function._cache = SimpleNamespace(_cache_file=file, _impl=SimpleNamespace())
        function.compile = None
        return function
    return same

numba.njit = interpreted  # the whole kernel checked but compiled takes four times as long
from servotwin.hybrid.compiled import bare

@bare
def beyond(x, k):
    return x[k]

try:
    beyond(np.zeros(3), 3)
except IndexError:
    pass
else:
    raise SystemExit("indices are not checked: this test would prove nothing")

import test_hybrid_automaton, test_hybrid_ball, test_hybrid_random
test_hybrid_ball.test_zeno_point_to_rounding_when_bounces_die_quickly()
test_hybrid_random.check_a_record_that_grows(2_500)
test_hybrid_random.test_standing_still_for_ever_is_safe()
test_hybrid_random.test_after_zeno_a_run_stays_refused_and_its_past_readable()
test_hybrid_automaton.test_jumps_at_one_instant_apply_in_order()
test_hybrid_automaton.test_any_part_of_the_samples()
test_hybrid_automaton.test_set_between_advances()

import servotwin as st
from servotwin.simulation.ensemble import Cases, simulate_members
servo = st.Servo.preset("table1").replace(n=2)
knots = [0.0, 0.1001, 0.10013, 0.15]
worn = st.PiecewiseCubic(knots, [[0.1, 0.2, 0, 0], [0.2, 0, 0, 0], [0.05, 0, 0, 0], [0, 0, 1, 1]])
wave, tolerance = st.SquareWave(1e-3, 0.125), servo.tolerance_for(math.radians(1.0))
limited = servo.controller.replace(voltage_limit=0.5, loop_filter_hz=20.0)
sampled = [limited.replace(sample_rate=1000.0), servo.controller.replace(sample_rate=5000.0)]
for law in (limited, *sampled):
    run = st.simulate(servo, 0.15, controller=law, reference=wave, gap=worn, tolerance=tolerance, noise=st.Noise(1e-5))
    assert len(run.events) > 5 and np.isfinite(run.q).all() and np.isfinite(run.voltage).all()
cases = Cases(1e-3, [0.0, 0.1, 0.2], [0.0, tolerance, tolerance])
assert simulate_members(servo, None, 0.15, cases)["error"].shape == (3, 16)
# Long enough for the vast scale of sampled loops in blocks.
from servotwin.simulation.sampled_ensemble import SampledCases, summarise_sampled
calm = sampled[1].replace(Ki=0.0, voltage_limit=24.0)
assert np.isfinite(st.simulate(servo, 10.0, controller=calm, reference=st.Step(1e-3), gap=0.1).q).all()
cases = SampledCases(1e-3, [0.0, 0.1], [0.0, tolerance], friction=[0.0, 1e-5], delay=[0, 2])
assert np.isfinite(summarise_sampled(servo, calm, 4.0, cases, 1.0, sample_rate=50.0)["error"].mean).all()
print("done")
"""


@pytest.mark.slow
def test_no_index_is_out_of_bounds(tmp_path: Path) -> None:
    folders = [str(Path(__file__).parent), *(path for path in sys.path if path)]
    env = os.environ | {"NUMBA_DISABLE_JIT": "1", "PYTHONPATH": os.pathsep.join(folders)}
    script = tmp_path / "runs.py"
    script.write_text(RUNS, encoding="utf-8")
    done = subprocess.run([sys.executable, script], env=env, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stderr[-4000:]
    assert done.stdout == "done\n"
