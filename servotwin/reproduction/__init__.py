"""The paper, reproduced: its figures, its claims and a report; a client of the package like any other.

Source: Vered & Elliott, "The use of digital twins to remotely update feedback controllers for the motion control of
nonlinear dynamic systems", Mechanical Systems and Signal Processing, 2023.
"""
