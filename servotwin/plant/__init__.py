"""The controlled machine: motor, lead screw with its gap, chain of masses, sensors, and the signals that drive them."""
