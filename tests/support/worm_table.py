"""Rotary table behind a worm gear of 90:1, with a cascade.

It swings at 92 Hz with hardly any damping: three samples of delay make the cascade unstable there.
"""

import servotwin as st

WORM_TABLE = st.Axis.loads(
    """
[actuator]
kind = "torque"
inertia_kg_m2 = 6e-4
current_loop_time_s = 5e-4
coulomb_friction_n_m = 0.25
viscous_friction_n_m_s_per_rad = 5e-4
torque_limit_n_m = 8.0
[transmission]
kind = "gear"
ratio = 90.0
stiffness_n_m_per_rad = 4e5
[load]
kind = "rotary"
inertia_kg_m2 = 1.2
damping_n_m_s_per_rad = 5.0
[sensors]
encoder_resolution_rad = 4.8e-5
position_resolution_rad = 4.8e-6
[controller]
kind = "cascade"
position_gain_per_s = 18.35
velocity_gain_n_m_s_per_rad = 0.07
integral_time_s = 0.0244
torque_limit_n_m = 8.0
sample_rate_hz = 2000.0
""",
    "worm.toml",
)
