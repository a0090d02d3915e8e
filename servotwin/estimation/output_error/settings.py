"""Settings of the output-error estimator."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from servotwin.config.keys import check, key, settings


@settings("output_error")
@dataclass(frozen=True)
class OutputErrorSettings:
    """Settings of the output-error estimator: what is known of the axis's numbers, and what is accepted."""

    stiffness: Annotated[
        float, key("stiffness_share", above=0.0, help="Standard deviation of each stiffness over the inertia.")
    ] = 0.08
    damping: Annotated[float, key("damping_share", above=0.0, help="Standard deviation of each damping.")] = 0.5
    mass_ratio: Annotated[
        float, key("mass_ratio_share", above=0.0, help="Standard deviation of the last mass over the others.")
    ] = 0.05
    ratio: Annotated[float, key("ratio_share", above=0.0, help="Standard deviation of the transmission's ratio.")] = (
        0.005
    )
    friction: Annotated[
        float,
        key(
            "friction_share",
            minimum=0.0,
            below=1.0,
            help="Half-width of the stated Coulomb friction of the load. If the gap holds the load, the friction that "
            "fits best is believed within it, and its doubt is in the interval; of a free shaft it counts where two "
            "windows of one flank each show the gap.",
        ),
    ] = 0.25
    delay: Annotated[
        float | None,
        key(
            "delay_s",
            above=0.0,
            help="Standard deviation of the delay between the channels; where absent three samples or a tenth of a "
            "radian of the shaft's own frequency, whichever is more.",
        ),
    ] = None
    largest_share: Annotated[
        float, key(above=0.0, help="Largest standard deviation of a gap that is accepted, of the gap.")
    ] = 0.05
    counts: Annotated[float, key(above=0.0, help="The same in counts of the encoders, where that is more.")] = 1.0
    model_share: Annotated[
        float, key(minimum=0.0, help="Standard deviation of unmodelled effects, of the gap; part of std_total.")
    ] = 0.002
    gap_rate: Annotated[
        float,
        key(
            "gap_rate_deg_per_s",
            minimum=0.0,
            help="Growth of the gap within the window that is thought possible, root mean square; part of std_total.",
        ),
    ] = 0.0
    calibration: Annotated[float, key(above=0.0, help="Reported over computed standard deviation.")] = 1.1

    def __post_init__(self) -> None:
        check(self)
