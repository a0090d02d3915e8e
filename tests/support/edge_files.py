"""Text of an edge's file, for tests that change it."""

_DRIVE_AND_LAW = """[drive]
kind = "simulated"
address = "unix:nothing.sock"
[controller]
kp_v_per_m = 1377.7
ki_v_per_m_s = 0.0
kd_v_s_per_m = -135.1
filter_time_s = 0.1
"""


def edge_file(role: str = "control", keys: str = "", tables: str = "") -> str:
    """Servo ax-1 at 1 kHz, without a twin; `keys` come before the first table, `tables` after the last."""
    return f'servo = "ax-1"\nrole = "{role}"\nsample_rate_hz = 1000.0\n{keys}{_DRIVE_AND_LAW}{tables}'
