"""Settings of the estimator from the motor's side."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from servotwin.config.keys import check, key, settings


@settings("motor_side")
@dataclass(frozen=True)
class MotorSideSettings:
    """Settings of the estimator from the motor's side: what is known of the axis's numbers, and what is accepted."""

    stiffness: Annotated[
        float, key("stiffness_share", above=0.0, help="Standard deviation of each stiffness over the inertia.")
    ] = 0.08
    screw: Annotated[
        float, key("screw_share", above=0.0, help="Standard deviation of the stiffness of a screw that the gap holds.")
    ] = 0.2
    damping: Annotated[
        float, key("damping_share", above=0.0, help="Standard deviation of each damping and friction.")
    ] = 0.3
    mass_ratio: Annotated[
        float, key("mass_ratio_share", above=0.0, help="Standard deviation of the last mass over the others.")
    ] = 0.05
    inertia: Annotated[
        float, key("inertia_share", above=0.0, help="Standard deviation of the load's inertia over the motor's.")
    ] = 0.1
    torque: Annotated[
        float, key("torque_share", above=0.0, help="Standard deviation of the torque per command over the inertia.")
    ] = 0.1
    largest_share: Annotated[
        float, key(above=0.0, help="Largest standard deviation of a gap that is accepted, of the gap.")
    ] = 0.1
    counts: Annotated[float, key(above=0.0, help="The same in counts of the encoder, where that is more.")] = 1.0
    model_share: Annotated[
        float, key(minimum=0.0, help="Standard deviation of unmodelled effects, of the gap; part of std_total.")
    ] = 0.01
    explained: Annotated[
        float,
        key(above=0.0, help="Largest residual that is accepted, over that of the best model without a gap."),
    ] = 0.5
    gap_rate: Annotated[
        float,
        key(
            "gap_rate_deg_per_s",
            minimum=0.0,
            help="Growth of the gap within the window that is thought possible, root mean square; part of std_total.",
        ),
    ] = 0.0

    def __post_init__(self) -> None:
        check(self)
